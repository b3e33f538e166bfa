"""Which images to match: one module a method, and `make_pair_list`, which runs the one of the options."""
