"""Monte Carlo experiments: one file for each kind of scenario, and the machinery that runs them."""
