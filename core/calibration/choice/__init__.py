"""Inputs of a fit: consistent views, the lens model, structure left in the residuals."""
