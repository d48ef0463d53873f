"""Other renderers, as peers to compare images and speed with."""
