"""SGAM over image collections, into COLMAP."""
