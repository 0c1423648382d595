"""Metrics of sets of points and of whole runs: OSPA, OSPA(2), GOSPA, RMSE, cardinality, NEES, identities."""
