"""Writers of other programs' formats, and subsets of scenario sets."""
