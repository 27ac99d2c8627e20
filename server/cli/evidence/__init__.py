"""Commands that show others what a result is worth: certificate, repetition, bundle, comparison with a model."""
