"""Compare a model of a machine with measurements, find the physics it lacks, add it, watch the error fall.

    import rotflex_jax as rf
    rec = rf.load("run.csv")
    train, test = rec.split(0.7)
    result = rf.discover(rf.joints.paper(), train, test)

Importing the package changes no setting of JAX. A name is loaded when it is first asked for, so a fit does
not wait for the search, the filters or a plot; `__init__.pyi` says which names there are and where they live.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"
