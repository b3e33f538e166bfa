"""Scripts that run in other Python environments, and the module they speak through; nothing here is imported by them
but `sgam_worker`."""
