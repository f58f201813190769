from .bands import Bands as Bands, prediction_bands as prediction_bands
from .greybox import fit as fit
from .identifiable import Identifiability as Identifiability, identifiable as identifiable
from .many_starts import ManyStarts as ManyStarts, many_starts as many_starts
from .profile import profile as profile
from .profile_result import Profile as Profile
from .result import Fit as Fit
from .series import (
    SeriesFit as SeriesFit,
    forward_regression as forward_regression,
    least_squares as least_squares,
)

__all__: list[str]
