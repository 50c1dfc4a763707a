"""Measurements of the package: speed, accuracy, Bayesian inference and other packages beside it."""
