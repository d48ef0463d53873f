"""Distributions of directions that guides learn: sampling, densities and gradients as functions for kernels."""
