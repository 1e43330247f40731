"""What posterior_table.py is made of: sets, methods, what is measured of them, and how it is shown."""
