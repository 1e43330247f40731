"""Machines that are none of the package's robots, with truths of plain MuJoCo; `foreign_machines.py` runs them.

What draws and simulates a machine imports mujoco and numpy and nothing of the package: a law that were wrong there
would be wrong here in another way. `running.py`, `score.py` and `summary.py` call the program and read its reports.
"""
