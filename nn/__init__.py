"""Encodings, fused networks, losses and optimisers. Knows nothing of rendering."""
