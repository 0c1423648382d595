"""Which detection belongs to which component: likelihoods, marginal probabilities, attributions."""
