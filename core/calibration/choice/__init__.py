"""What a fit is made of: views that hold, the lens model, structure left in the residuals."""
