"""Machines with and without faults, and what each detector says of their windows."""
