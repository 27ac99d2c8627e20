"""Commands that show others what a result is worth: repetition, bundle, comparison with a model."""
