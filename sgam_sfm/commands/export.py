"""`sgam-sfm export`: the keypoints and matches of a run as COLMAP's text files."""

from __future__ import annotations

from rich.console import Console

from sgam_core.wording import counted
from sgam_sfm.exit_codes import DONE
from sgam_sfm.stage_options import ExportOptions


def run(options: ExportOptions, console: Console) -> int:
    """Write the files; print the commands that read them."""
    from sgam_sfm.colmap.reading import each_keypoints, each_matches, read_camera_ids
    from sgam_sfm.colmap.text import require_plain_names, write_keypoints_text, write_matches_text
    from sgam_sfm.inputs import refuse_among_images
    from sgam_sfm.runs.results import open_results

    results = open_results(options.results, options.images)
    refuse_among_images(options.output, results.images)
    database = results.database()
    require_plain_names(read_camera_ids(database))
    num_images = write_keypoints_text(options.output / "keypoints", each_keypoints(database))
    num_pairs = write_matches_text(options.output / "matches.txt", each_matches(database))
    lines = (
        ("written", f"{counted(num_images, 'keypoint file')}, {counted(num_pairs, 'pair')} in matches.txt"),
        (
            "next",
            f"colmap feature_importer --database_path new.db --image_path {results.images} "
            f"--import_path {options.output / 'keypoints'}",
        ),
        (
            "",
            f"colmap matches_importer --database_path new.db --match_list_path {options.output / 'matches.txt'} "
            "--match_type raw",
        ),
    )
    for what, text in lines:
        console.print(f"{what:<10} {text}", highlight=False, markup=False, soft_wrap=True)
    return DONE
