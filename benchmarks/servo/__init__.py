"""Hobby servos: the extended friction models fitted by evolution, beside a grey-box model of the firmware."""
