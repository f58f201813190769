from .forward_regression import forward_regression as forward_regression
from .greybox import fit as fit
from .least_squares import least_squares as least_squares
from .many_starts import ManyStarts as ManyStarts, many_starts as many_starts
from .series_fit import SeriesFit as SeriesFit

__all__: list[str]
