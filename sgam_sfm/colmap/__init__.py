"""All that speaks to COLMAP: its databases, cameras, verification, mappers and models."""
