"""Commands that prove a result to others: certificate, repetition, bundle, comparison with a model."""
