"""Numbers of the wrong worlds to tune on and to report; a world of one set is never in the other."""

TUNING, REPORT = tuple(range(204, 404)), tuple(range(3000, 3200))
