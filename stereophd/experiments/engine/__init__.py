"""The machinery of experiments: plan, store, run, summarise."""
