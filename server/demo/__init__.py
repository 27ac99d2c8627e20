"""The paper's three experiments on the simulated rig, driven over HTTP, and their comparison with the truth."""
