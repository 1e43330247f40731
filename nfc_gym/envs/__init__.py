"""The robots' environments: one robot a file, and two engines, one simulation or a batch, that run the same laws."""
