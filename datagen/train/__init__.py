"""Training, evaluation and prediction: everything that reads runs to learn from them."""
