"""SGAM: semantic area-to-point matching with geometric consistency, as functions over immutable values."""
