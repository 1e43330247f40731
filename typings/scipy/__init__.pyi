"""What this package uses of SciPy, which says no types: to infer them from its source takes longer than all the rest.

A function that is missing here goes unchecked; its arguments are as `help` of it has them.
"""
