"""Golden outputs: all that the package writes and says on fixed cases, kept as references that later
revisions are held against.

`cases` makes them, `difference` compares them, `scripts/golden` is the command.  A reference is compressed
JSON: every JSON file, the terminal's texts, the pages' tags and words, and a digest of every generated loop.
"""
