"""`sgam-sfm pairs`: choose which images to match."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from rich.console import Console

from sgam_core.wording import counted
from sgam_sfm.exit_codes import DONE, SOME_FAILED
from sgam_sfm.logs import logging_to
from sgam_sfm.pair_lists.options import PairsOptions

_MAX_NAMED = 5


def run(options: PairsOptions, console: Console) -> int:
    """Write the list; say what is in it, what is not, and what to do next."""
    from sgam_sfm.pair_lists.descriptors import default_run
    from sgam_sfm.pair_lists.graph import connected_parts
    from sgam_sfm.pair_lists.making import make_pair_list
    from sgam_sfm.progress import Stages

    method = options.method
    with logging_to(None, console, verbose=method.verbose):
        made = make_pair_list(method, Stages(console=console))

    def tell(what: str, text: str) -> None:
        console.print(f"{what:<10} {text}", highlight=False, markup=False, soft_wrap=True)

    parts = connected_parts(made.pairs)
    paired = {name for part in parts for name in part}
    alone = [name for name in made.names if name not in paired]
    count = len(made.names) * (len(made.names) - 1) // 2
    tell("pairs", f"{len(made.pairs)} of {count} that {counted(len(made.names), 'image')} can make, in {method.output}")
    if alone:
        tell("warning", f"{counted(len(alone), 'image')} in no pair, and so without a pose: {_some(alone)}")
    if len(parts) > 1:
        told = _some([f"{counted(len(part), 'image')} ({part[0]}, ...)" for part in parts])
        tell(
            "warning",
            f"no pair joins these {len(parts)} groups: {told}; each becomes a model of its own. If they show one "
            "scene, give more pairs: a larger --num or --overlap, a lower --min-score, or --loop-closure",
        )
    else:
        tell("graph", f"one part: pairs join {'all' if not alone else 'the other'} {counted(len(paired), 'image')}")
    if made.failed:
        tell("failed", f"{counted(len(made.failed), 'image')} that cannot be compared: {_some(list(made.failed))}")
    command = ["sgam-sfm", "match", "--images", method.images, "--pairs", method.output]
    command += ["--output", default_run(method.output)]
    tell("next", shlex.join(map(str, command)))
    return SOME_FAILED if made.failed else DONE


def _some(texts: Sequence[str]) -> str:
    more = f" and {len(texts) - _MAX_NAMED} more" if len(texts) > _MAX_NAMED else ""
    return ", ".join(texts[:_MAX_NAMED]) + more
