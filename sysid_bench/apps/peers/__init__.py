"""Peers: estimators that fit closed-loop simulations by general optimisers of other packages."""
