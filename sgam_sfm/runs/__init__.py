"""A run over a collection: pairs matched in blocks, kept, resumed and counted; `runner` is where to begin."""
