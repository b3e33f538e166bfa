"""`sgam-sfm show`: pictures of what a run did."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from sgam_core.errors import OptionError
from sgam_sfm.exit_codes import DONE


@dataclass(frozen=True, kw_only=True)
class ShowOptions:
    """Draw what a run did: a pair, an image, or the whole collection.

    Two names: the areas and point matches of the pair, with the plain matcher's beneath when it was run. One name: the
    image's labels, areas, keypoints and tracks. None: a contact sheet with the match graph. Needs no display.
    """

    output: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Result folder of a run, finished or not."""
    names: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[NAME [NAME]]", help_behavior_hint="")
    ] = ()
    """No, one or two image names, as in the pair list."""
    save: Path | None = None
    """File of the picture: png, jpg, webp, tif, pdf or svg. Without it: a png in OUT/pictures."""
    images: Path | None = None
    """Folder of the images, where it is no longer the one that the run was given."""
    plain: Path | None = None
    """Result folder of `--area-matcher none`, drawn beneath a pair. Without it: looked for beside OUT."""

    def __post_init__(self) -> None:
        if len(self.names) > 2:
            raise OptionError(
                f"{len(self.names)} image names were given; give two for a pair, one for an image, or none"
            )
        if self.plain is not None and len(self.names) < 2:
            raise OptionError("--plain is drawn beneath a pair; give the names of two images")


def run(options: ShowOptions, console: Console) -> int:
    """Draw the picture and print where it is."""
    from sgam_sfm.pictures import collection_picture, image_picture, pair_picture, save_picture
    from sgam_sfm.runs.results import find_plain, open_plain, open_results

    results = open_results(options.output, options.images)
    if len(options.names) == 2:
        name0, name1 = options.names
        pair = results.pair(name0, name1)
        plain = open_plain(options.plain, results.images) if options.plain else find_plain(results, pair)
        figure = pair_picture(results, pair, plain)
    elif options.names:
        figure = image_picture(results, options.names[0])
    else:
        figure = collection_picture(results)
    path = options.save or default_path(options.output, options.names)
    save_picture(figure, path)
    console.print(f"picture    {path}", highlight=False, markup=False, soft_wrap=True)
    return DONE


def default_path(output: Path, names: tuple[str, ...]) -> Path:
    """Where a picture goes without --save."""
    stem = "--".join(name.replace("/", "-") for name in names) or "collection"
    return output / "pictures" / f"{stem}.png"
