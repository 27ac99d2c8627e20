"""The paper's three experiments and their comparison with the truth."""
