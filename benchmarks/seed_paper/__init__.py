"""The tables that worked the seed paper through, beside numbers computed without this package.

One module per table has `blocks(quick, say)`, which yields its parts as `Block`. `reference.json`
holds the numbers of independent prototypes; `blocks.py` sets the two side by side, `page.py` prints
them.
"""
