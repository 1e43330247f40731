"""What is measured beside the table's cells."""

EXTRAS: dict = {}
