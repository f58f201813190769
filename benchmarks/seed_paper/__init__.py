"""B2: tables of results on the seed paper, compared with values computed without this package.

One module per table has a function `blocks(quick, say)` that yields the parts of the table as `Block`.
`reference.json` has the values of independent prototypes, `blocks.py` compares the two, and `page.py` writes
them as Markdown.
"""
