"""What of the site is made by scripts: the catalogue of effects, the reference, formulas."""
