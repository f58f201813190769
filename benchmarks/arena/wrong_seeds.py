"""Seeds of the wrong worlds for tuning and for reports; no world belongs to both sets."""

TUNING, REPORT = tuple(range(204, 404)), tuple(range(3000, 3400))
