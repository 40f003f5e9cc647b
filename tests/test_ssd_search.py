"""The search for templates: exact on bytes, bounded elsewhere, the same on every family of kernels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import tolerances
from adof_cl import reference, ssd_search
from adof_cl.device import Device
from adof_cl.errors import DeviceError, InputError, TrackingError
from adof_cl.ssd_search import LARGEST_TEMPLATE, SsdSearch

FAMILIES = ("lanes", "groups")
families = pytest.mark.parametrize("family", FAMILIES)
Image = NDArray[Any]


def picture(seed: int, shape: tuple[int, int], dtype: str) -> Image:
    rng = np.random.default_rng(seed)
    if dtype == "float32":
        return rng.normal(0.4, 0.2, shape).astype(np.float32)
    return rng.integers(0, np.iinfo(dtype).max, shape, endpoint=True).astype(dtype)


def cut(image: Image, corner_yx: tuple[int, int], shape: tuple[int, int]) -> Image:
    y, x = corner_yx
    return image[y : y + shape[0], x : x + shape[1]].copy()


def windows(seed: int, image: tuple[int, int], search: tuple[int, int], count: int) -> NDArray[np.int64]:
    rng = np.random.default_rng(seed)
    return np.stack(
        [rng.integers(0, n - s, count, endpoint=True) for n, s in zip(image, search, strict=True)], 1
    )


def check_bytes(device: Device, family: str, template: tuple[int, int], image: Image, seed: int) -> None:
    """Every score bit-equal to int64 sums, and the best place the reference's."""
    search = (min(template[0] + 11, image.shape[0]), min(template[1] + 70, image.shape[1]))
    plan = SsdSearch(device, image.shape, template, search, 2, family=family)
    origins = windows(seed, image.shape, search, 2)
    rng = np.random.default_rng(seed + 1)
    templates = rng.integers(230, 255, (2, *template), endpoint=True).astype(np.uint8)  # the largest odd sums
    templates[1] = np.where(templates[1] < 242, 0, 255)
    plan.set_templates(templates)
    plan.set_windows(origins)
    found = plan.search(image)
    maps = plan.score_maps()
    for k in range(2):
        origin = (int(origins[k, 0]), int(origins[k, 1]))
        best, scores = reference.ssd_search(image, templates[k], origin, search)
        assert scores.dtype == np.int64
        np.testing.assert_array_equal(maps[k], scores)
        assert tuple(found.best_yx[k]) == best
        assert found.score[k] == scores.min()


@families
@pytest.mark.parametrize("template", [(1, 1), (5, 3), (20, 20), (64, 64)])
def test_byte_scores_are_bit_equal_to_int64_arithmetic(
    device: Device, family: str, template: tuple[int, int]
) -> None:
    if device.facts.simulated and max(template) > 5:
        pytest.skip("a simulator takes minutes for this size")
    image = picture(3, (83, 141), "uint8")
    image[:, 20:110] |= 0b11100000  # bright: float32 alone would not hold the sums
    check_bytes(device, family, template, image, 7)


@families
def test_byte_scores_are_exact_at_the_largest_sum_there_is(device: Device, family: str) -> None:
    size = (3, 5) if device.facts.simulated else (LARGEST_TEMPLATE, LARGEST_TEMPLATE)
    search = (size[0] + 11, size[1] + 70)
    plan = SsdSearch(device, search, size, search, 1, family=family)
    plan.set_templates(np.zeros((1, *size), np.uint8))
    image = np.full(search, 255, np.uint8)
    found = plan.search(image)
    assert found.score[0] == 255**2 * size[0] * size[1]
    assert tuple(found.best_yx[0]) == (0, 0)


@pytest.fixture(scope="module", params=FAMILIES)
def small_plan(request: pytest.FixtureRequest, device: Device) -> SsdSearch:
    return SsdSearch(device, (29, 67), (5, 3), (16, 60), 3, family=request.param, patch_margin=2)


levels = st.sampled_from([(0, 255), (0, 1), (127, 129), (254, 255), (7, 7)])


@settings(max_examples=15)
@given(seed=st.integers(0, 2**31), grey=levels)
def test_any_window_of_any_bytes_gives_the_references_scores_and_place(
    small_plan: SsdSearch, seed: int, grey: tuple[int, int]
) -> None:
    rng = np.random.default_rng(seed)
    image = rng.integers(*grey, (29, 67), endpoint=True).astype(np.uint8)
    templates = rng.integers(*grey, (3, 5, 3), endpoint=True).astype(np.uint8)
    origins = windows(seed, image.shape, (16, 60), 3)
    small_plan.set_templates(templates)
    small_plan.set_windows(origins)
    found = small_plan.search(image)
    maps = small_plan.score_maps()
    assert found.patches is not None
    edged = np.pad(image, 2, mode="edge")
    for k in range(3):
        origin = (int(origins[k, 0]), int(origins[k, 1]))
        best, scores = reference.ssd_search(image, templates[k], origin, (16, 60))
        np.testing.assert_array_equal(maps[k], scores)
        assert tuple(found.best_yx[k]) == best
        framed = np.pad(scores.astype(float), 1, constant_values=np.inf)
        y, x = best[0] - origin[0], best[1] - origin[1]
        np.testing.assert_array_equal(found.neighbourhood[k], framed[y : y + 3, x : x + 3])
        np.testing.assert_array_equal(found.patches[k], edged[best[0] : best[0] + 9, best[1] : best[1] + 7])


def test_of_equal_scores_the_first_in_row_major_order_is_the_best(small_plan: SsdSearch) -> None:
    period = picture(5, (7, 9), "uint8")
    image = np.tile(period, (5, 8))[:29, :67].copy()
    small_plan.set_templates(np.stack([cut(image, (y, x), (5, 3)) for y, x in ((7, 9), (12, 40), (20, 62))]))
    small_plan.set_windows([(0, 0), (3, 7), (13, 1)])
    found = small_plan.search(image)
    assert (found.score == 0).all()
    expected = []
    for k, origin in enumerate(((0, 0), (3, 7), (13, 1))):
        template = cut(image, ((7, 9), (12, 40), (20, 62))[k], (5, 3))
        expected.append(reference.ssd_search(image, template, origin, (16, 60))[0])
    np.testing.assert_array_equal(found.best_yx, expected)


@families
@pytest.mark.parametrize(("dtype", "template"), [("uint16", (21, 19)), ("float32", (7, 5))])
def test_other_images_are_within_the_bound_of_summing_row_by_row(
    device: Device, family: str, dtype: str, template: tuple[int, int]
) -> None:
    if device.facts.simulated:
        template = (3, 5)
    image = picture(11, (61, 83), dtype)
    search = (template[0] + 13, template[1] + 52)
    plan = SsdSearch(device, image.shape, template, search, 2, dtype=dtype, family=family)
    places = [(8, 9), (15, 33)]
    templates = np.stack([cut(image, place, template) for place in places])
    templates[1] = picture(12, template, dtype)
    plan.set_templates(templates)
    plan.set_windows([(2, 3), (7, 11)])
    found = plan.search(image)
    maps = plan.score_maps()
    for k, origin in enumerate(((2, 3), (7, 11))):
        best, scores = reference.ssd_search(image.astype(np.float64), templates[k], origin, search)
        assert tuple(found.best_yx[k]) == best
        limit = tolerances.ssd_relative(*template)
        np.testing.assert_array_less(np.abs(maps[k] - scores), limit * scores + 1e-300)
    assert found.score[0] == 0


@families
def test_a_faint_picture_on_a_bright_16_bit_image_keeps_its_place_where_the_expanded_form_loses_it(
    device: Device, family: str
) -> None:
    size = (3, 5) if device.facts.simulated else (21, 19)
    rng = np.random.default_rng(1)
    image = (50_000 + rng.integers(-30, 30, (61, 83))).astype(np.uint16)
    search = (size[0] + 13, size[1] + 52)
    plan = SsdSearch(device, image.shape, size, search, 1, dtype=np.uint16, family=family)
    template = cut(image, (9, 14), size)
    noisy = (template + rng.integers(-5, 6, size)).astype(np.uint16)
    plan.set_templates(noisy[None])
    plan.set_windows([(2, 3)])
    found = plan.search(image)
    best, scores = reference.ssd_search(image, noisy, (2, 3), search)
    assert tuple(found.best_yx[0]) == best == (9, 14)
    np.testing.assert_allclose(plan.score_maps()[0], scores, rtol=1e-5)

    places = np.lib.stride_tricks.sliding_window_view(
        image[2 : 2 + search[0], 3 : 3 + search[1]].astype(np.float32), size
    )
    flat = noisy.astype(np.float32)
    expanded = (
        np.einsum("yxrc,yxrc->yx", places, places)
        - 2 * np.einsum("yxrc,rc->yx", places, flat)
        + np.float32((flat * flat).sum())
    )
    assert np.abs(expanded - scores).max() > 0.1 * scores.min()


@families
@pytest.mark.parametrize("template", [(2, 1), (20, 20), (64, 64)])
def test_the_gain_and_offset_score_of_bytes_is_within_its_bound(
    device: Device, family: str, template: tuple[int, int]
) -> None:
    if device.facts.simulated and max(template) > 5:
        pytest.skip("a simulator takes minutes for this size")
    image = picture(21, (83, 141), "uint8")
    image[40:, :] //= 64  # a dark, faint half
    search = (template[0] + 11, template[1] + 70)
    plan = SsdSearch(device, image.shape, template, search, 2, score="gain_offset", family=family)
    rng = np.random.default_rng(22)
    templates = rng.integers(0, 255, (2, *template), endpoint=True).astype(np.uint8)
    templates[1] //= 32
    templates[:, 0, 0] = (0, 5)
    templates[:, -1, -1] = (200, 3)
    plan.set_templates(templates)
    plan.set_windows([(1, 2), (8, 1)])
    plan.search(image)
    maps = plan.score_maps()
    taps = template[0] * template[1]
    for k, origin in enumerate(((1, 2), (8, 1))):
        _, scores = reference.ssd_search(image, templates[k], origin, search, score="gain_offset")
        y, x = origin
        places = np.lib.stride_tricks.sliding_window_view(
            image[y : y + search[0], x : x + search[1]].astype(np.float64), template
        )
        squares = places.var(axis=(2, 3)) * taps
        limit = tolerances.gain_offset_bytes(taps, squares, templates[k].astype(float).var() * taps)
        textured = squares > 0
        assert (np.abs(maps[k] - scores)[textured] <= limit[textured]).all()
        assert (maps[k][~textured] > 1 - limit[textured].max()).all()


@families
@pytest.mark.parametrize(("dtype", "template"), [("uint16", (21, 19)), ("float32", (7, 5))])
def test_the_gain_and_offset_score_of_other_images_is_within_its_bound(
    device: Device, family: str, dtype: str, template: tuple[int, int]
) -> None:
    if device.facts.simulated:
        template = (3, 5)
    image = picture(31, (61, 83), dtype)
    if dtype == "uint16":
        image = (65_000 + image // 13_000).astype(np.uint16)  # bright and faint
    else:
        image = (1e6 + 10 * image).astype(np.float32)
    search = (template[0] + 13, template[1] + 52)
    plan = SsdSearch(
        device, image.shape, template, search, 1, dtype=dtype, score="gain_offset", family=family
    )
    wanted = cut(image, (9, 14), template)
    brighter = (
        (2 * (wanted - 64_990)).astype(dtype) if dtype == "uint16" else (3 * (wanted - 1e6)).astype(dtype)
    )
    plan.set_templates(brighter[None])
    plan.set_windows([(2, 3)])
    found = plan.search(image)
    best, scores = reference.ssd_search(
        image.astype(float), brighter.astype(float), (2, 3), search, score="gain_offset"
    )
    assert tuple(found.best_yx[0]) == best == (9, 14)
    spread = image.astype(float)
    limit = tolerances.gain_offset_real(*template, float(np.ptp(spread) / spread.std()) * 2)
    assert np.abs(plan.score_maps()[0] - scores).max() <= limit


@families
def test_gain_and_offset_leave_the_place_where_the_plain_score_loses_it(device: Device, family: str) -> None:
    size = (3, 5) if device.facts.simulated else (20, 20)
    rng = np.random.default_rng(41)
    shaded = 40 + np.arange(141) + 4 * rng.normal(size=(83, 141))
    image = np.clip(shaded, 0, 255).astype(np.uint8)
    template = cut(image, (9, 14), size)
    brighter = (template.astype(np.float64) * 1.2 + 25).astype(np.uint8)
    search = (size[0] + 11, size[1] + 70)
    places = {}
    for score in ("ssd", "gain_offset"):
        plan = SsdSearch(device, image.shape, size, search, 2, score=score, family=family)
        plan.set_templates(np.stack([brighter, template]))
        plan.set_windows([(1, 2), (1, 2)])
        places[score] = plan.search(image).best_yx.tolist()
    assert places["gain_offset"] == [[9, 14], [9, 14]]
    assert places["ssd"][0] != [9, 14]


@families
def test_a_place_that_holds_nan_is_never_the_best(device: Device, family: str) -> None:
    image = picture(51, (61, 83), "float32")
    wanted = cut(image, (9, 14), (7, 5))
    image[30, 40] = np.nan
    image[34, 48] = np.nan  # the second window's middle
    image[12, 60] = np.inf
    for score in ("ssd", "gain_offset"):
        plan = SsdSearch(
            device, image.shape, (7, 5), (20, 57), 2, dtype=np.float32, score=score, family=family
        )
        plan.set_templates(np.stack([wanted, wanted]))
        plan.set_windows([(2, 3), (24, 20)])
        found = plan.search(image)
        assert tuple(found.best_yx[0]) == (9, 14)
        for scores, (y, x), bad in zip(
            plan.score_maps(), ((2, 3), (24, 20)), ([(12, 60)], [(30, 40), (34, 48)]), strict=True
        ):
            beyond = np.isinf(scores)
            rows, columns = np.indices(scores.shape)
            holds = np.zeros(scores.shape, np.bool_)
            for row, column in bad:
                row, column = row - y - rows, column - x - columns
                holds |= (row >= 0) & (row < 7) & (column >= 0) & (column < 5)
            np.testing.assert_array_equal(beyond, holds)
            assert not np.isnan(scores).any()


def test_windows_and_templates_may_change_between_calls(small_plan: SsdSearch) -> None:
    image = picture(61, (29, 67), "uint8")
    on_device = small_plan.device.upload(image)
    small_plan.set_templates(np.stack([cut(image, (4, 5), (5, 3))] * 3))
    small_plan.set_windows([(0, 0), (2, 3), (4, 5)])
    small_plan(on_device)
    assert small_plan.fetch().best_yx.tolist() == [[4, 5]] * 3
    small_plan.set_template(1, cut(image, (20, 60), (5, 3)))
    small_plan.set_windows([(0, 0), (13, 7), (4, 5)])
    small_plan(on_device)
    assert small_plan.fetch().best_yx.tolist() == [[4, 5], [20, 60], [4, 5]]


def test_a_window_that_leaves_the_image_is_refused_or_moved_inside_by_the_smallest_move(
    small_plan: SsdSearch,
) -> None:
    with pytest.raises(InputError, match=r"window 2 at \(14, 0\) leaves the image"):
        small_plan.set_windows([(0, 0), (13, 7), (14, 0)])
    used = small_plan.set_windows([(-5, 3), (99, 99), (4, -1)], clamp=True)
    assert used.tolist() == [[0, 3], [13, 7], [4, 0]]


def test_what_cannot_be_searched_is_refused(device: Device, small_plan: SsdSearch) -> None:
    refused: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = [
        ("count is 0", ((9, 9), (2, 2), (5, 5), 0), {}),
        ("choose uint8, uint16 or float32", ((9, 9), (2, 2), (5, 5), 1), {"dtype": np.float64}),
        ("choose 'ssd' or 'gain_offset'", ((9, 9), (2, 2), (5, 5), 1), {"score": "zncc"}),
        ("choose 'lanes' or 'groups'", ((9, 9), (2, 2), (5, 5), 1), {"family": "cpu"}),
        ("at most 64 pixels a side", ((90, 90), (65, 2), (80, 5), 1), {}),
        ("do not nest", ((9, 9), (6, 2), (5, 5), 1), {}),
        ("do not nest", ((9, 9), (2, 2), (10, 5), 1), {}),
        ("whole numbers of 1 or more", ((9, 9), (0, 2), (5, 5), 1), {}),
        ("patch_margin is -1", ((9, 9), (2, 2), (5, 5), 1), {"patch_margin": -1}),
        ("one pixel has no contrast", ((9, 9), (1, 1), (5, 5), 1), {"score": "gain_offset"}),
    ]
    for words, arguments, options in refused:
        with pytest.raises(InputError, match=words):
            SsdSearch(device, *arguments, **options)
    with pytest.raises(InputError, match="convert them first"):
        small_plan.set_templates(np.zeros((2, 5, 3), np.uint8))
    with pytest.raises(InputError, match="convert it first"):
        small_plan.set_template(0, np.zeros((5, 3), np.uint16))
    with pytest.raises(InputError, match="0 to 2 was wanted"):
        small_plan.set_template(3, np.zeros((5, 3), np.uint8))
    with pytest.raises(InputError, match="integers were wanted"):
        small_plan.set_windows(np.zeros((3, 2)))
    with pytest.raises(InputError, match="convert it first"):
        small_plan.search(np.zeros((29, 67), np.float32))
    with pytest.raises(InputError, match="build the search for this image"):
        small_plan(device.upload(np.zeros((28, 67), np.uint8)))


def test_a_search_with_a_template_never_set_is_refused(device: Device) -> None:
    plan = SsdSearch(device, (29, 67), (5, 3), (16, 60), 3, patch_margin=2)
    plan.set_template(0, np.zeros((5, 3), np.uint8))
    with pytest.raises(InputError, match="template 1 was never set"):
        plan.search(np.zeros((29, 67), np.uint8))


def test_templates_without_contrast_or_not_finite_are_refused(device: Device) -> None:
    plan = SsdSearch(device, (61, 83), (7, 5), (20, 57), 2, dtype=np.float32, score="gain_offset")
    with pytest.raises(TrackingError, match=r"one grey level, 0\.5"):
        plan.set_template(0, np.full((7, 5), 0.5, np.float32))
    with pytest.raises(InputError, match="value of nan: finite levels"):
        plan.set_template(0, np.full((7, 5), np.nan, np.float32))


@pytest.mark.parametrize("vector_bytes", [16, 32, 64])
def test_bytes_are_exact_with_vectors_of_every_width(
    device: Device, monkeypatch: pytest.MonkeyPatch, vector_bytes: int
) -> None:
    monkeypatch.setattr(device, "vector_bytes", vector_bytes)
    check_bytes(device, "lanes", (5, 3), picture(3, (83, 141), "uint8"), 7)


@pytest.mark.parametrize("columns", [2, 9, 10, 17, 40])
def test_bytes_are_exact_in_windows_narrower_and_wider_than_a_vector(device: Device, columns: int) -> None:
    image = picture(3, (12, columns), "uint8")
    plan = SsdSearch(device, image.shape, (4, 2), image.shape, 1, family="lanes")
    template = cut(image, (3, columns - 2), (4, 2))
    plan.set_templates(template[None])
    found = plan.search(image)
    best, scores = reference.ssd_search(image, template, (0, 0), image.shape)
    np.testing.assert_array_equal(plan.score_maps()[0], scores)
    assert tuple(found.best_yx[0]) == best


@pytest.mark.parametrize("score", ["ssd", "gain_offset"])
@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_however_a_window_is_cut_into_tiles_the_answer_is_the_same(
    device: Device, monkeypatch: pytest.MonkeyPatch, dtype: str, score: str
) -> None:
    image = np.tile(picture(71, (20, 50), dtype), (2, 3))  # every place but the last rows' and columns' twice
    answers = []
    for most in (2**20, 1):
        monkeypatch.setattr(ssd_search, "_TILE_TAPS", most)
        plan = SsdSearch(
            device,
            image.shape,
            (5, 3),
            (36, 140),
            2,
            dtype=dtype,
            score=score,
            family="lanes",
            patch_margin=1,
        )
        plan.set_templates(np.stack([cut(image, (y, x), (5, 3)) for y, x in ((13, 41), (17, 3))]))
        plan.set_windows([(2, 5), (4, 10)])
        found = plan.search(image)
        answers.append((found.best_yx, found.neighbourhood, found.patches, plan.score_maps()))
    for one, many in zip(*answers, strict=True):
        np.testing.assert_array_equal(one, many)


def test_a_device_with_too_little_local_memory_is_refused_in_words(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "facts", replace(device.facts, local_memory_bytes=8192))
    with pytest.raises(DeviceError, match="bytes of local memory"):
        SsdSearch(device, (90, 90), (64, 64), (80, 80), 1, dtype=np.float32, family="groups")
