"""B10: extended friction models fitted by CMA-ES, and grey-box models of the firmware, of hobby servos."""
