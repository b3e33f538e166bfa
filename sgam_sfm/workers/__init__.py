"""Scripts that run in other Python environments, and `sgam_worker`, the one module that they have of us."""
