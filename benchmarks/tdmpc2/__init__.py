"""TD-MPC2 (Hansen, Su and Wang 2024, arXiv:2310.16828), one task at a time: the tables' model-based baseline.

settings -> networks -> world_model -> planner, learner -> replay, collecting -> run. `agent` acts with what was
learned, `pretraining` is a run in the package's simulator, `suite` has tasks that the authors published results of.
"""
