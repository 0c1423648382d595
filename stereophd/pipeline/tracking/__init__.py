"""Events through a filter or an estimator, to records."""
