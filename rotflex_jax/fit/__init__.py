"""Fits: parameters of a mechanism, or weights of a basis, from recordings, with robust intervals.

The two kinds of fits are independent of each other. A name is loaded when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
