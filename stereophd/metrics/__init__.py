"""Metrics of sets of points and of whole runs: OSPA, GOSPA, RMSE, cardinality, NEES, identity switches."""
