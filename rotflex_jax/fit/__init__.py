"""Fits: parameters of a mechanism, or weights of a basis, from recordings, with honest intervals.

The two know nothing of each other, and a name is loaded when it is first asked for.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
