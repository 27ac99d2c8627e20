"""Long sequences: later references, composed motions, propagated covariance."""
