"""Checks the shapes and types of annotated functions while tests run; an int may stand for a float."""

import os

from beartype import BeartypeConf, beartype

if "PYTEST_XDIST_WORKER" in os.environ:  # read when torch is imported: processes side by side have a core each
    os.environ.setdefault("OMP_NUM_THREADS", "1")

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
