import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sgam_core.crops import area_crop, box_crop, warped_alike, whole_crop
from sgam_core.errors import OptionError, ShapeError
from sgam_core.options import CropOptions, GuidanceOptions
from sgam_core.types import Box, Image, WarpedCrop
from tests.textures import similarity, transfer, view


def image(width: int, height: int, **more) -> Image:
    y, x = np.mgrid[:height, :width]
    return Image(name="a.jpg", pixels=np.stack([x % 256, y % 256, (x + y) % 256], axis=2).astype(np.uint8), **more)


@given(
    st.integers(1, 900),
    st.integers(1, 900),
    st.floats(0, 1),
    st.floats(0, 1),
    st.floats(0.01, 1),
    st.floats(0.01, 1),
    st.integers(1, 700),
    st.just(0) | st.floats(1, 5),
)
def test_crop_then_uncrop_is_the_identity(width, height, x, y, w, h, area_size, max_upsampling):
    box = Box(x0=x * width, y0=y * height, x1=(x + w) * width, y1=(y + h) * height)
    crop = area_crop(
        Image(name="a", pixels=np.zeros((height, width, 3), np.uint8)),
        box,
        CropOptions(area_size=area_size, max_upsampling=max_upsampling),
    )
    assert 0 <= crop.window.x0 < crop.window.x1 <= width
    assert 0 <= crop.window.y0 < crop.window.y1 <= height
    assert max(crop.size) <= max(area_size, 1)
    points = np.random.default_rng(0).uniform(0, 1, (20, 2)) * [width, height]
    affine = crop.crop_from_image
    there = points @ affine[:, :2].T + affine[:, 2]
    np.testing.assert_allclose(crop.to_image(there), points, atol=1e-6)
    corners = np.array([[crop.window.x0, crop.window.y0], [crop.window.x1, crop.window.y1]])
    np.testing.assert_allclose(corners @ affine[:, :2].T + affine[:, 2], [[0, 0], list(crop.size)], atol=1e-6)
    if max_upsampling:
        assert crop.scale <= max_upsampling + 1 / min(crop.window.width, crop.window.height)  # whole pixels


@pytest.mark.parametrize("make", [CropOptions, GuidanceOptions])
def test_a_limit_of_enlarging_that_would_shrink_is_refused(make):
    with pytest.raises(OptionError, match=r"max_upsampling is 0.5; expected at least 1 \(never enlarge\), or 0"):
        make(max_upsampling=0.5)


def test_small_images_are_enlarged_only_where_that_is_asked_for():
    small = image(300, 200)
    assert whole_crop(small, CropOptions(image_size=1024)).size == (300, 200)
    assert whole_crop(small, CropOptions(image_size=1024, max_whole_upsampling=2)).size == (600, 400)
    assert whole_crop(small, CropOptions(image_size=450, max_whole_upsampling=0)).size == (450, 300)
    box = Box(x0=0, y0=0, x1=100, y1=50)
    assert box_crop(small, box, 800, 1).size == (100, 50)
    assert box_crop(small, box, 800, 2).size == (200, 100)
    enlarged = box_crop(small, box, 800, 0)
    assert enlarged.size == enlarged.gray().shape[::-1] == (800, 400)


def test_a_crop_is_a_square_about_its_area_at_the_images_own_resolution():
    crop = area_crop(image(1000, 800), Box(x0=400, y0=300, x1=600, y1=400), CropOptions(area_size=640))
    assert crop.window == Box(x0=380, y0=230, x1=620, y1=470)  # 1.2 x 200 = 240
    assert crop.size == (240, 240)
    np.testing.assert_array_equal(crop.pixels(), image(1000, 800).pixels[230:470, 380:620])


@pytest.mark.parametrize("size", [512, 400, 256, 171, 100])
def test_much_smaller_crops_show_what_direct_means_of_areas_do(size):
    noise = np.random.default_rng(0).integers(0, 256, (768, 1024, 3), np.uint8)
    pixels = cv2.normalize(cv2.GaussianBlur(noise, None, 8), None, 0, 255, cv2.NORM_MINMAX)
    crop = whole_crop(Image(name="a", pixels=pixels), CropOptions(image_size=size))
    direct = cv2.resize(pixels, crop.size, interpolation=cv2.INTER_AREA).astype(int)
    difference = crop.pixels() - direct
    assert np.abs(difference).mean() < 0.05 * direct.std()
    assert abs(difference.mean()) < 0.5  # each halving rounds


def test_a_crop_is_shifted_inside_and_cut_where_it_does_not_fit():
    crop = area_crop(image(1000, 300), Box(x0=0, y0=0, x1=500, y1=280), CropOptions(area_size=300))
    assert crop.window == Box(x0=0, y0=0, x1=600, y1=300)
    assert crop.size == (300, 150)
    assert crop.scale == 0.5


def test_resizing_moves_pixel_centres_by_the_half_pixel_rule():
    # Shrinking by two: the centre of crop pixel (0, 0) lies between the first four image pixels.
    crop = whole_crop(image(200, 100), CropOptions(image_size=100))
    np.testing.assert_allclose(crop.to_image(np.array([[0.5, 0.5]])), [[1.0, 1.0]])
    np.testing.assert_allclose(crop.pixels()[0, :3, 0], [0, 2, 4], atol=1)


def test_masks_are_cut_with_the_pixels_and_never_interpolated():
    mask = np.zeros((100, 200), bool)
    mask[:, 100:] = True
    crop = whole_crop(image(200, 100, mask=mask), CropOptions(image_size=50))
    found = crop.mask()
    assert found is not None
    assert found.shape == (25, 50)
    np.testing.assert_array_equal(found[0], np.arange(50) >= 25)


def test_a_mask_of_another_size_is_named(unchecked):
    with pytest.raises(ShapeError, match=r"mask of 'a.jpg' is 10x10 but the image is 100x200 \(height x width\)"):
        image(200, 100, mask=np.ones((10, 10), bool))


def test_an_image_that_is_not_rgb_is_named(unchecked):
    with pytest.raises(ShapeError, match=r"image 'g' is uint8 \(4, 4, 1\); expected uint8 \(height, width, 3\) RGB"):
        Image(name="g", pixels=np.zeros((4, 4, 1), np.uint8))


def test_an_empty_box_is_refused():
    with pytest.raises(ShapeError, match="is empty; expected x0 < x1"):
        Box(x0=3, y0=0, x1=3, y1=2)


@given(st.integers(1, 60), st.integers(1, 60), st.integers(1, 90), st.integers(0, 3), st.integers(0, 3))
def test_a_turned_crop_is_the_crop_turned_anticlockwise(width, height, long_side, turns, more):
    crop = whole_crop(image(width, height, mask=np.eye(height, width, dtype=bool)), CropOptions(image_size=long_side))
    turned = crop.turned(90 * turns).turned(90 * more)
    np.testing.assert_array_equal(turned.pixels(), np.rot90(crop.pixels(), turns + more))
    np.testing.assert_array_equal(turned.mask(), np.rot90(crop.mask(), turns + more))
    assert min(turned.pixels().strides) > 0  # torch takes no others, and numpy calls some of one pixel contiguous
    assert turned.size == turned.pixels().shape[1::-1]
    assert turned.scale == crop.scale
    assert (turned.key == crop.key) == ((turns + more) % 4 == 0)
    rows, columns = np.mgrid[: crop.size[1], : crop.size[0]]
    centres = np.stack([columns, rows], axis=2) + 0.5
    moved = np.rot90(centres, turns + more).reshape(-1, 2)  # where each pixel of the turned crop was before
    seen = np.stack(np.meshgrid(*(np.arange(side) + 0.5 for side in turned.size)), axis=2).reshape(-1, 2)
    np.testing.assert_allclose(turned.to_image(seen), crop.to_image(moved), atol=1e-9)
    affine = turned.crop_from_image
    np.testing.assert_allclose(turned.to_image(seen) @ affine[:, :2].T + affine[:, 2], seen, atol=1e-9)


def slanted(scale: float, degrees: float, slant: float) -> np.ndarray:
    """An affine map (3, 3): across is seen so many times shorter, then all is turned and resized."""
    return similarity(scale, degrees, (30, 20), (200, 150)) @ np.diag([1, 1 / slant, 1])


SIZE = (400, 300)


@pytest.mark.parametrize("affine", [slanted(1, 0, 2), slanted(0.7, 20, 1.5), slanted(1.4, -35, 1.2), slanted(1, 90, 1)])
def test_crops_that_are_warped_look_alike(affine):
    images = [Image(name=str(row), pixels=view(seen, SIZE)) for row, seen in enumerate((np.eye(3), affine))]
    boxes = Box(x0=90, y0=60, x1=290, y1=240), Box(x0=70, y0=30, x1=330, y1=260)
    crops = [box_crop(image, box, 220, 1) for image, box in zip(images, boxes, strict=True)]
    alike = warped_alike(*crops, affine[:2])
    assert sum(isinstance(crop, WarpedCrop) for crop in alike) == 1
    assert alike[0].size == alike[1].size
    for crop, before in zip(alike, crops, strict=True):
        assert crop.scale <= before.scale * (1 + 1e-9)  # no crop is enlarged
        assert crop.key != before.key or crop is before

    rows, columns = np.mgrid[: alike[0].size[1], : alike[0].size[0]]
    centres = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    places = [crop.to_image(centres) for crop in alike]
    np.testing.assert_allclose(transfer(affine, places[0]), places[1], atol=1e-6)
    for crop, seen in zip(alike, places, strict=True):
        inverse = crop.crop_from_image
        np.testing.assert_allclose(seen @ inverse[:, :2].T + inverse[:, 2], centres, atol=1e-9)

    shown = np.ones(alike[0].size[::-1], bool)
    for crop in alike:
        shown &= True if crop.mask() is None else crop.mask()
    assert shown.mean() > 0.4
    difference = np.abs(alike[0].pixels().astype(float) - alike[1].pixels())[shown]
    apart = np.abs(crops[0].pixels().astype(float) - np.roll(crops[0].pixels(), 4, axis=1))
    assert difference.mean() < 0.4 * apart.mean()


def test_where_a_warped_crop_shows_nothing_its_mask_says_so():
    plain = image(200, 100)
    known = image(200, 100, mask=np.arange(200) < np.full((100, 1), 150))
    for photo, end in ((plain, 200), (known, 150)):
        crop0 = whole_crop(image(200, 100), CropOptions(image_size=200))
        crop1 = whole_crop(photo, CropOptions(image_size=200))
        _, warped = warped_alike(crop0, crop1, np.array([[1.0, 0, 60], [0, 1, 10]]))
        expected = np.zeros((100, 200), bool)
        expected[:90, : end - 60] = True
        np.testing.assert_array_equal(warped.mask(), expected)
        np.testing.assert_array_equal(warped.pixels()[expected], crop1.pixels()[10:, 60:end].reshape(-1, 3))


@given(st.integers(20, 60), st.integers(20, 60), st.integers(20, 90), st.integers(1, 359))
def test_a_crop_that_is_turned_aslant_shows_all_that_it_showed(width, height, long_side, degrees):
    crop = whole_crop(image(width, height), CropOptions(image_size=long_side))
    turned = crop.turned(degrees)
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
    affine = turned.crop_from_image
    seen = crop.to_image(corners * crop.size) @ affine[:, :2].T + affine[:, 2]
    np.testing.assert_allclose(seen.min(axis=0), 0, atol=1)
    np.testing.assert_allclose(seen.max(axis=0), turned.size, atol=1)
    np.testing.assert_allclose(turned.to_image(seen), crop.to_image(corners * crop.size), atol=1e-6)
    x, y = affine[:, 0] / np.linalg.norm(affine[:, 0])  # where image x points to
    off = np.rad2deg(np.arctan2(-y, x)) - degrees
    assert abs((off + 180) % 360 - 180) < 1
    assert turned.pixels().shape[1::-1] == turned.size
    mask = turned.mask()
    if degrees % 90:
        assert mask is not None
        assert mask.sum() == pytest.approx(crop.size[0] * crop.size[1], rel=0.15)
        assert turned.key != crop.key
    back = turned.turned(360 - degrees).crop_from_image
    np.testing.assert_allclose(back[:, :2], crop.crop_from_image[:, :2], atol=1e-9)


def test_a_crop_that_is_turned_aslant_looks_so():
    bright = np.zeros((60, 80, 3), np.uint8)
    bright[:, 40:] = 255  # bright on the right: above, when turned anticlockwise by a quarter
    crop = whole_crop(Image(name="half", pixels=bright), CropOptions(image_size=80))
    pixels = crop.turned(45).pixels()[..., 0]
    centre = pixels.shape[0] // 2
    assert pixels[centre - 15, centre + 15] == 255  # above on the right
    assert pixels[centre + 15, centre - 15] == 0
    shown = crop.turned(45).contains(np.array([(centre, centre), (2, 2), (-1, centre)], float))
    assert shown.tolist() == [True, False, False]  # the corners show nothing
    assert abs(float(pixels[centre - 15, centre - 15]) - 128) < 90  # on the line between


@pytest.mark.parametrize("degrees", [0, 90, 30])
@pytest.mark.parametrize("long_side", [40, 200, 420])
def test_the_gray_of_a_crop_is_that_of_its_pixels(long_side, degrees):
    shown = Image(name="a", pixels=view(np.eye(3), (240, 180)))
    crop = box_crop(shown, Box(x0=20, y0=30, x1=220, y1=140), long_side, 0).turned(degrees)
    expected = cv2.cvtColor(crop.pixels(), cv2.COLOR_RGB2GRAY)
    assert crop.gray().dtype == np.uint8
    # Each is rounded twice or three times.
    np.testing.assert_allclose(crop.gray().astype(int), expected, atol=3)
