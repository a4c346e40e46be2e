"""Datasets as minibatches of tensors."""
