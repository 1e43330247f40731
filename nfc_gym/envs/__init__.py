"""The robots' environments: one robot a file, and two engines, a single simulation and a batch, that run the same laws."""
