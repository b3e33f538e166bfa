"""From the output folder of a run to its pictures."""

from __future__ import annotations

from collections import Counter

from matplotlib.figure import Figure

from sgam_core.errors import InputError
from sgam_sfm.pairs import Pair
from sgam_sfm.pictures.canvas import ImageView
from sgam_sfm.pictures.collection import CollectionPicture, ImageEntry, draw_collection
from sgam_sfm.pictures.image import ImagePicture, draw_single_image
from sgam_sfm.pictures.pair import Matching, PairPicture, draw_pair
from sgam_sfm.runs.results import Results

_NO_DATABASE = "COLMAP's inliers (no database.db)"


def pair_picture(results: Results, pair: Pair, plain: Results | None = None) -> Figure:
    """The picture of a pair, its first image at the left.

    Args: plain: the output of the plain matcher, drawn beneath where it has the pair.
    Raises: InputError when the pair or its images are not there, see `Results.pair`; also for the plain matcher's.
    """
    result = results.result(results.pair(*pair))
    assert result is not None  # or `pair` would have said so
    whole = results.options.get("area_matcher") == "none"
    views = (_view(results, pair[0]), _view(results, pair[1]))
    inliers = results.inliers(pair)
    beneath = None
    if plain is not None:
        plain_result = plain.result(plain.pair(*pair))
        assert plain_result is not None
        title = f"The plain matcher on whole images ({plain.folder.resolve().name})"
        beneath = Matching(title=title, result=plain_result, inliers=plain.inliers(pair))
    unlabelled = " and ".join(f"'{view.name}'" for view in views if view.labels is None)
    missing = []
    if whole:
        missing.append("areas (the run was made with --area-matcher none)")
    elif unlabelled:
        missing.append(f"labels of {unlabelled} (no label map)")
    if inliers is None:
        missing.append(_NO_DATABASE if results.counts() is None else "COLMAP's inliers (the pair is not verified)")
    return draw_pair(
        PairPicture(
            views=views,
            matching=Matching(title="Matches on whole images" if whole else "Matches", result=result, inliers=inliers),
            plain=beneath,
            missing=missing,
            label_names=results.label_names(),
        )
    )


def image_picture(results: Results, name: str) -> Figure:
    """The picture of an image: labels, the areas of all its pairs, keypoints and tracks.

    Raises: InputError when the run does not know the image, could not use it, or its file has gone.
    """
    view = _view(results, results.usable(name))
    found, keypoints = results.model_image(name), results.keypoints(name)
    missing = ["labels (no label map)"] if view.labels is None else []
    if keypoints is None:
        missing.append("keypoints (no database.db)")
    elif found is None:
        missing.append(
            "tracks (the image has no pose in any model)" if results.models() else "tracks (no model in sparse)"
        )
    return draw_single_image(
        ImagePicture(
            view=view,
            results=dict(results.results_of(name)),
            num_listed=len(results.partners(name)),
            keypoints=keypoints if found is None else found[1].points,
            track_lengths=None if found is None else found[1].track_lengths,
            model="" if found is None else found[0],
            missing=missing,
            label_names=results.label_names(),
        )
    )


def collection_picture(results: Results) -> Figure:
    """The contact sheet of a run with its match graph.

    Raises: InputError when the run has not come so far as to know an image.
    """
    if not results.names:
        raise InputError(f"'{results.folder}' knows of no image yet; start the same run again")
    counts, registered, models = results.counts(), results.registered(), results.models()
    verified = {} if counts is None else counts.inliers
    partners = Counter(name for pair in verified for name in pair)
    entries = [
        ImageEntry(
            name=name,
            keypoints=None if counts is None else counts.keypoints.get(name, 0),
            verified=None if counts is None else partners[name],
            model=registered.get(name, "") if models else None,
            error=results.failed.get(name, ""),
            no_pose=results.failed_poses.get(name, ""),
        )
        for name in results.names
    ]

    def thumbnail(name: str) -> ImageView | None:
        try:
            return ImageView.of(name, results.pixels(name))
        except InputError:
            return None

    why = "`localize` makes no database" if results.references else "no database.db"
    missing = [f"keypoints and verified pairs ({why})"] if counts is None else []
    missing += [] if models else ["registered images (no model in sparse)"]
    unusable = sum(not results.failed.keys().isdisjoint(pair) for pair in results.listed - results.blocks.keys())
    return draw_collection(
        CollectionPicture(
            title=results.folder.resolve().name,
            entries=entries,
            inliers=verified,
            num_listed=len(results.listed),
            num_matched=len(results.blocks) - len(results.errors),
            num_failed=len(results.errors) + unusable,
            missing=missing,
        ),
        thumbnail,
    )


def _view(results: Results, name: str) -> ImageView:
    return ImageView.of(name, results.pixels(name), results.labels(name))
