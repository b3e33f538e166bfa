"""The collection that comes with the project: a room, rendered, matched, reconstructed and compared with the truth."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from rich.console import Console

from sgam_core.types import AreaState
from sgam_sfm.evaluation.pose_errors import PoseErrors, compare_poses
from sgam_sfm.files import write_json
from sgam_sfm.options import MatchOptions
from sgam_sfm.pictures import collection_picture, pair_picture, save_picture
from sgam_sfm.progress import Stages
from sgam_sfm.runs.results import open_results
from sgam_sfm.runs.runner import match_collection
from sgam_sfm.runs.store import PairRecord, read_pairs_of
from sgam_sfm.runs.summary import print_summary
from sgam_sfm.scene import demo_views, write_scene

_NUM_PICTURES = 4


def run_demo(output: Path, device: str, threads: int, console: Console) -> tuple[MatchOptions, dict[str, Any]]:
    """Render the room, run the main job on it, draw a few pairs with their areas, and compare the model with the truth.

    Everything but the number of threads and the device has its default, and that one camera took all photos: a close-up
    alone tells little of a focal length. Started again, it continues where it stopped.

    Returns: the options and the summary of the run; `pose_errors` in it are of the registered images.
    """
    stages = Stages(console=console)
    scene = output / "scene"
    if not (scene / "pairs.txt").exists():  # written last
        views = demo_views()
        with stages.stage("Rendering the room", len(views)) as advance:
            write_scene(scene, views, advance=lambda _: advance(1))
    options = MatchOptions(
        images=scene / "images",
        pairs=scene / "pairs.txt",
        output=output / "sgam",
        camera_mode="single",
        device=device,
        threads=threads,
    )
    summary = match_collection(options, stages)
    print_summary(summary, console)
    told = [("picture", str(picture)) for picture in draw_pictures(options, output / "pictures")]
    database, model = options.output / "database.db", options.output / "sparse" / "0"
    told.append(("database", str(database)))
    look = ["colmap", "gui", "--database_path", database, "--image_path", options.images]
    if summary["models"]:
        errors = compare_poses(model, scene / "ground_truth")
        summary["pose_errors"] = errors
        write_json(options.output / "summary.json", summary)
        told = [("truth", _truth(errors)), *told, ("model", str(model))]
        look += ["--import_path", model]
    image = min(path.name for path in options.images.iterdir())
    told.append(("next", f"where COLMAP is installed, in three dimensions: {shlex.join(map(str, look))}"))
    told.append(("", f"an image with its labels: {shlex.join(['sgam-sfm', 'show', str(options.output), image])}"))
    for what, text in told:
        console.print(f"{what:<10} {text}", highlight=False, soft_wrap=True, markup=False)
    return options, summary


def _truth(errors: PoseErrors) -> str:
    return (
        f"camera centres off by {1000 * errors.median_center:.1f} mm, directions by "
        f"{errors.median_rotation_deg:.3f} degrees (medians of {errors.num_images} images, in a room of 6 m); furthest "
        f"off is {errors.worst}, by {1000 * errors.max_center:.1f} mm"
    )


def draw_pictures(options: MatchOptions, folder: Path) -> list[Path]:
    """Pictures of the collection and of the pairs with most areas kept, no image twice where it can be helped.

    Pairs with areas of the labels come first: most pairs of the room agree as whole images, and have guided areas only.
    """
    records = [record for record in read_pairs_of(options.output) if record.result is not None]
    records.sort(key=lambda record: (-_kept(record, guided=False), -_kept(record, guided=True), record.pair))
    chosen: list[PairRecord] = []
    for again in (False, True):
        for record in records:
            seen = {name for other in chosen for name in other.pair}
            if len(chosen) < _NUM_PICTURES and record not in chosen and (again or not seen & set(record.pair)):
                chosen.append(record)
    results = open_results(options.output)
    figures = {"collection": collection_picture(results)}
    for pair in (record.pair for record in chosen):
        figures["-".join(Path(name).stem for name in pair)] = pair_picture(results, pair)
    for name, figure in figures.items():
        save_picture(figure, folder / f"{name}.png")
    return [folder / f"{name}.png" for name in figures]


def _kept(record: PairRecord, *, guided: bool) -> int:
    areas = () if record.result is None else record.result.areas
    return sum(area.state is AreaState.KEPT and (area.area0.kind == "guided") is guided for area in areas)
