"""Compare a model of a machine with measurements, and find and add the physics that it lacks.

    import rotflex_jax as rf
    rec = rf.load("run.csv")
    train, test = rec.split(0.7)
    result = rf.discover(rf.joints.paper(), train, test)

Importing the package changes no setting of JAX. A name is loaded when it is first used, so a fit does not
wait for the search, the filters or a plot; `__init__.pyi` lists the names and their modules.
"""

import copyreg
import importlib
import importlib.util
import sys
from types import ModuleType
from typing import Any

import lazy_loader

__version__ = "0.1.0"

_listed, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """A listed name, or a module of the package that is not listed, such as `runtime`."""
    if name not in __all__ and importlib.util.find_spec(f"{__name__}.{name}"):
        return importlib.import_module(f"{__name__}.{name}")
    return _listed(name)


def _by_name(module: ModuleType) -> tuple[Any, tuple[str]]:
    return importlib.import_module, (module.__name__,)


# A package with lazy names has its own class, which cloudpickle does not recognise as a module: functions of
# a notebook that use this package could otherwise not be sent to other processes.
copyreg.pickle(type(sys.modules[__name__]), _by_name)
