"""Laws of the hidden world: where things fall, what light does to them, when they touch."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.ndimage import shift as moved

from adof_cl import reference, twin
from adof_cl.errors import InputError
from adof_cl.optics import Mask, OpticalSystem
from adof_cl.twin import parts
from adof_cl.twin.pupil import Pupil, read_codes
from adof_cl.twin.render import Layer

Image = NDArray[np.float64]
LINEAR = np.rint(255 / 256 * np.arange(256)).astype(np.uint8)
OPTICS = OpticalSystem()


def codes(mask: Mask) -> NDArray[np.uint8]:
    panel = twin.Design().panel
    stop_px = panel.stop_px(OPTICS.aperture_um)
    return reference.slm_encode(
        (panel.rows, panel.columns), stop_px, LINEAR, mask.alpha_rad, mask.focus_psi_rad
    )


def show(rig: twin.Twin, mask: Mask) -> None:
    rig.slm.show(codes(mask))
    rig.clock.wait(2 * rig.slm.settling_s)


def noiseless(rig: twin.Twin, camera: int) -> tuple[Image, float]:
    """The whole sensor's radiance at the next moment, and that moment."""
    design = rig.design
    now_s = rig.clock.now_s
    shape = (design.rows, design.columns)
    image = rig.world.radiance(camera, now_s, now_s + design.exposure_s, (0, 0), shape)
    return image.astype(np.float64), now_s + design.exposure_s / 2


def restored(image: Image, mask: Mask, psi_rad: float, nsr: float) -> Image:
    pad = 96
    wide = np.pad(image, pad, mode="edge")
    hy, hx = (
        reference.otf_1d(OPTICS.frequency_axis(n), mask.alpha_rad, mask.focus_psi_rad + psi_rad)
        for n in wide.shape
    )
    h = np.outer(hy, hx)
    return np.fft.ifft2(np.fft.fft2(wide) * h.conj() / (np.abs(h) ** 2 + nsr)).real[pad:-pad, pad:-pad]


def plate_as_projected(rig: twin.Twin, camera: int, time_s: float, rows: range, columns: range) -> Image:
    """The plate's paint, looked up where each fifth of a pixel's sight line meets it; no blur, no peg."""
    world, split = rig.world, 5
    matrix, origin = world.projection(camera)
    pose = world.hole_pose(time_s)
    c, s = math.cos(pose.theta_rad), math.sin(pose.theta_rad)
    pixels_from_plate = matrix[:, :2] @ np.array([[c, -s], [s, c]])
    centre = matrix @ pose.xyz_um + origin
    inside = (np.arange(split) - (split - 1) / 2) / split
    y = (np.array(rows)[:, None] + inside).ravel()
    x = (np.array(columns)[:, None] + inside).ravel()
    sight = np.stack([g.ravel() for g in np.meshgrid(x, y)]) - centre[:, None]
    place = np.linalg.inv(pixels_from_plate) @ sight / parts.PITCH_UM
    paint = world._plate
    index = [place[1] + paint.centre_yx[0], place[0] + paint.centre_yx[1]]
    seen = map_coordinates(paint.planes[0], index, order=1)
    return seen.reshape(len(rows), split, len(columns), split).mean(axis=(1, 3)) + parts.BACKGROUND


def displacement(image: Image, original: Image) -> NDArray[np.float64]:
    """(x, y) by which `image` is `original` moved; least squares with gain and offset."""
    inner = (slice(8, -8), slice(8, -8))
    target, smooth = gaussian_filter(image, 1.0)[inner], gaussian_filter(original, 1.0)
    found = np.zeros(2)
    for _ in range(8):
        guess = moved(smooth, found[::-1], order=3, mode="nearest")
        gy, gx = np.gradient(guess)
        terms = np.stack([-gx[inner], -gy[inner], guess[inner], np.ones_like(target)]).reshape(4, -1)
        found = found + np.linalg.lstsq(terms.T, target.ravel(), rcond=None)[0][:2]
    return found


def corner_window(rig: twin.Twin, camera: int, time_s: float, margin: int = 30) -> tuple[range, range]:
    """Around the hole's +x +y corner, away from a peg that lies towards -x -y."""
    x, y = np.rint(rig.world.corners_px(camera, "hole", time_s)[2]).astype(int)
    return range(y - margin, y + margin), range(x - margin, x + margin)


# ---- geometry ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("camera", [1, 2])
def test_the_frame_shows_the_hole_where_the_truth_says(seed: int, camera: int) -> None:
    start = twin.Start(280.0, 260.0, math.radians(4), 3800.0)
    rig = twin.build(seed, start=start, slm_pixels=False)
    if camera == 1:
        mask = Mask(0.0, -rig.world.psi_rad(1, "hole"))
        show(rig, mask)
    else:
        mask = rig.design.mask_2
    image, time_s = noiseless(rig, camera)
    sharp = restored(image, mask, rig.world.psi_rad(camera, "hole", time_s), 1e-4)
    rows, columns = corner_window(rig, camera, time_s)
    original = plate_as_projected(rig, camera, time_s, rows, columns)
    found = displacement(sharp[rows.start : rows.stop, columns.start : columns.stop], original)
    # The corners' promised truth.
    assert np.abs(found).max() < 0.01


def test_with_no_misalignment_the_cameras_are_as_drawn() -> None:
    rig = twin.build(0, misalignment=twin.Misalignment.none())
    for camera in (1, 2):
        drawn, true = rig.design.projection(camera), rig.world.projection(camera)
        np.testing.assert_array_equal(drawn[0], true[0])
        np.testing.assert_array_equal(drawn[1], true[1])
    tilt, pitch = rig.design.tilt_rad, rig.design.optics_2.object_pitch_um
    np.testing.assert_allclose(drawn[0] * pitch, [[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0]], atol=1e-15)


def test_each_cameras_defocus_is_that_of_the_depth_along_its_own_axis() -> None:
    rig = twin.build(11)
    for camera, optics in ((1, rig.design.optics_1), (2, rig.design.optics_2)):
        across, down = rig.world.projection(camera)[0]
        axis = np.cross(across, down)
        axis /= np.linalg.norm(axis)
        for part, pose in (("hole", rig.world.hole_pose()), ("peg", rig.world.peg_pose())):
            assert rig.world.psi_rad(camera, part) == pytest.approx(
                optics.psi_rad(axis @ pose.xyz_um), abs=1e-9
            )


def test_a_drawn_rig_differs_from_its_drawing_by_no_more_than_half_a_degree_and_half_a_percent() -> None:
    angle = math.radians(0.5) * (1 + 1e-9)
    for seed in range(50):
        secret = twin.Misalignment.drawn(np.random.default_rng(seed))
        for axis in range(3):
            assert secret.coarse_axes[axis, axis] >= math.cos(angle)
        assert abs(secret.fine_axes[0, 1]) <= math.sin(angle)
        assert max(map(abs, secret.scale_error)) <= 0.005
        assert abs(secret.tilt_error_rad) <= angle
        start = twin.Start.drawn(np.random.default_rng(seed), twin.Design())
        assert max(abs(start.x_um), abs(start.y_um)) <= 300
        assert abs(start.theta_rad) <= math.radians(5)
        assert 3500 <= start.depth_um <= 4000


@pytest.mark.parametrize("tilt_deg", [30.0, 45.0])
def test_four_millimetres_of_depth_stay_in_both_regions_of_interest(tilt_deg: float) -> None:
    design = twin.Design(tilt_rad=math.radians(tilt_deg))
    first = np.array(design.region_origin_yx)[::-1]
    size = np.array([design.region_columns, design.region_rows])
    for x in (-300.0, 300.0):
        rig = twin.build(
            0, design=design, start=twin.Start(x, 300.0, 0.087, 4000.0), misalignment=twin.Misalignment.none()
        )
        for _ in range(2):
            for camera in (1, 2):
                for part in ("hole", "peg"):
                    corners = rig.world.corners_px(camera, part) - first
                    # Half a template beyond every corner.
                    assert corners.min() > 10
                    assert (size - corners).min() > 10
            rig.coarse.move_to({"z": -3990.0, "x": -x})
            rig.coarse.wait_until_still()


@pytest.mark.parametrize("tilt_deg", [30.0, 40.0])
def test_camera_2_keeps_every_depth_within_half_the_reach_of_its_mask(tilt_deg: float) -> None:
    design = twin.Design(tilt_rad=math.radians(tilt_deg))
    mask = design.mask_2
    for z, x in [(0.0, 300.0), (0.0, -300.0), (4000.0, 300.0), (4000.0, -300.0), (2000.0, 0.0)]:
        depth = z * math.cos(design.tilt_rad) - x * math.sin(design.tilt_rad)
        assert abs(mask.psi_rad(design.optics_2, depth)) <= 1.5 * mask.alpha_rad * 1.01


def test_an_impossible_design_is_refused() -> None:
    for wrong in (
        {"tilt_rad": math.radians(60)},
        {"tilt_rad": 0.0},
        {"exposure_s": 0.02},
        {"region_rows": 500},
        {"full_well_e": -1.0},
    ):
        with pytest.raises(InputError):
            twin.Design(**wrong)
    with pytest.raises(InputError):
        twin.AxisDesign(3.0, 1000.0, 1.0, -1.0)
    with pytest.raises(InputError):
        twin.Design().projection(3)
    with pytest.raises(InputError):
        twin.Start(math.nan, 0.0, 0.0, 4000.0)


def test_questions_about_things_that_are_not_there_are_refused() -> None:
    world = twin.build(0).world
    for ask in (
        lambda: world.corners_px(3, "hole"),
        lambda: world.corners_px(1, "gripper"),
        lambda: world.psi_rad(1, "gripper"),
        lambda: world.psi_rad(3, "hole"),
    ):
        with pytest.raises(InputError):
            ask()
    with pytest.raises(InputError):
        twin.build(-1)


# ---- light ------------------------------------------------------------------------------------------------


def box_part(width_um: float, depth_um: float) -> parts.Painted:
    x, x0 = parts._axis(-width_um / 2, width_um / 2)
    y, y0 = parts._axis(-depth_um / 2, depth_um / 2)
    half = (width_um / 2, depth_um / 2)
    return parts.Painted(parts._box(x, y, width_um, depth_um)[None], (y0, x0), (-half[0], -half[1]), half)


@pytest.mark.parametrize(
    ("mask", "psi_rad"),
    [(Mask(), 0.0), (Mask(), 20.0), (Mask(40.0), 0.0), (Mask(53.5), 60.0), (Mask(-20.0), 15.0)],
)
def test_a_turned_box_is_imaged_as_its_analytic_spectrum_says(mask: Mask, psi_rad: float) -> None:
    width_um, depth_um, theta = 230.0, 170.0, 0.3
    c, s = math.cos(theta), math.sin(theta)
    matrix = np.array([[c, -s], [s, c]]) * np.array([[0.9], [1.0]]) / 7.4
    centre = np.array([101.37, 77.81])
    layer = Layer(OPTICS)
    planes, first = layer.image(box_part(width_um, depth_um), matrix, centre, Pupil.glass(mask), psi_rad)
    rows, columns = planes.shape[1:]
    aliases = range(-2, 3)
    fy = np.add.outer(aliases, np.fft.fftfreq(rows)).ravel()
    fx = np.add.outer(aliases, np.fft.fftfreq(columns)).ravel()
    # Frequencies in the box's own axes, cycles per um; its area in pixels scales its spectrum.
    gx = matrix[0, 0] * fx + matrix[1, 0] * fy[:, None]
    gy = matrix[0, 1] * fx + matrix[1, 1] * fy[:, None]
    spectrum = (
        width_um * depth_um * abs(np.linalg.det(matrix)) * np.sinc(gx * width_um) * np.sinc(gy * depth_um)
    )
    spectrum = spectrum * np.exp(-2 * np.pi**2 * parts._EDGE_UM**2 * (gx**2 + gy**2))
    place = centre - np.array(first[::-1])

    def along(f: Image, shift_px: float) -> NDArray[np.complex128]:
        u = 2 * f / 7.4 * OPTICS.wavelength_um * OPTICS.f_number
        h = reference.otf_1d(u, mask.alpha_rad, mask.focus_psi_rad + psi_rad)
        return h * np.sinc(f) * np.exp(-2j * np.pi * f * shift_px)

    spectrum = spectrum * along(fy, place[1])[:, None] * along(fx, place[0])
    folded = spectrum.reshape(len(aliases), rows, len(aliases), columns).sum(axis=(0, 2))
    expected = np.fft.ifft2(folded).real
    # The grid ends at 1.5 cycles a pixel; beyond, an edge of spectrum 1/(2 pi nu) still passes, in focus,
    # 0.21 (pixel) * 0.27 (optics) * 0.07 (softness) of itself: below 1e-3. Interpolation does the rest.
    assert np.abs(planes[0] - expected).max() < 2e-3
    assert planes[0].sum() == pytest.approx(width_um * depth_um * abs(np.linalg.det(matrix)), rel=2e-5)


def test_no_mask_and_no_defocus_change_the_light_in_all() -> None:
    part, matrix, centre = box_part(230.0, 170.0), np.eye(2) / 7.4, np.array([80.2, 70.6])
    layer = Layer(OPTICS)
    plain = layer.image(part, matrix, centre, Pupil.glass(Mask()), 0.0)[0].sum()
    for mask, psi in [
        (Mask(53.5), 0.0),
        (Mask(53.5), 120.0),
        (Mask(0.0, 30.0), 10.0),
        (Mask(-80.0, -60.0), 60.0),
    ]:
        blurred = layer.image(part, matrix, centre, Pupil.glass(mask), psi)[0].sum()
        # float32 sums over some 1e5 pixels.
        assert blurred == pytest.approx(plain, rel=1e-5)


def test_what_the_panels_steps_send_aside_lands_in_its_first_orders() -> None:
    psi = 120.0
    pupil = read_codes(codes(Mask(0.0, -psi)), twin.Design().panel, OPTICS.aperture_um)
    centre = np.array([300.0, 200.0])
    planes, first = Layer(OPTICS).image(box_part(60.0, 60.0), np.eye(2) / 7.4, centre, pupil, psi)
    across = planes[0].sum(axis=0)
    order_px = OPTICS.wavelength_um * OPTICS.f_number * OPTICS.aperture_um / (32.0 * 7.4)
    off = np.abs(first[1] + np.arange(across.size) - centre[0])
    near_orders = np.abs(off - order_px) < order_px / 2
    # Light of the second orders, and tails, lie elsewhere.
    assert across[near_orders].sum() / across.sum() == pytest.approx(pupil.along_x.order_leak, rel=0.2)
    assert across[off < order_px / 2].sum() / across.sum() == pytest.approx(
        1 - pupil.along_x.order_leak, rel=0.02
    )


@pytest.mark.parametrize(("depth_um", "alpha_rad"), [(4000.0, 100.0), (3000.0, 80.0)])
@pytest.mark.parametrize("slm_pixels", [False, True])
def test_a_deep_coded_hole_is_displaced_as_predicted_and_its_own_filter_brings_it_back(
    depth_um: float, alpha_rad: float, slm_pixels: bool
) -> None:
    rig = twin.build(
        5,
        misalignment=twin.Misalignment.none(),
        start=twin.Start(300.0, 300.0, 0.0, depth_um),
        slm_pixels=slm_pixels,
    )
    mask = Mask(alpha_rad)
    show(rig, mask)
    image, time_s = noiseless(rig, 1)
    psi = rig.world.psi_rad(1, "hole", time_s)
    predicted = OPTICS.shift_px(alpha_rad, psi)
    rows, columns = corner_window(rig, 1, time_s)
    original = plate_as_projected(rig, 1, time_s, rows, columns)
    whole = round(predicted)
    wrong = restored(image, mask, 0.0, 1e-3)
    window = wrong[rows.start + whole : rows.stop + whole, columns.start + whole : columns.stop + whole]
    found = displacement(window, original) + whole
    # Stationary phase, and a defocused image compared with a sharp one.
    np.testing.assert_allclose(found, predicted, rtol=0.1)
    own = restored(image, mask, psi, 1e-3)
    left = displacement(own[rows.start : rows.stop, columns.start : columns.stop], original)
    # What the noise-to-signal term leaves of an uneven transfer function; and the panel's steps, which send
    # up to 6 % of the light 151 px away, unknown to the filter.
    assert np.abs(left).max() < (0.15 if slm_pixels else 0.04)


def test_focusing_on_the_hole_by_the_modulator_is_sharpest_at_its_true_defocus() -> None:
    rig = twin.build(3)
    true = rig.world.psi_rad(1, "hole")
    sharpness = []
    offsets = (-8.0, -2.0, 0.0, 2.0, 8.0)
    for offset in offsets:
        show(rig, Mask(0.0, -true + offset))
        image, time_s = noiseless(rig, 1)
        rows, columns = corner_window(rig, 1, time_s, 20)
        window = image[rows.start : rows.stop, columns.start : columns.stop]
        sharpness.append(float((np.diff(window, axis=0) ** 2).sum() + (np.diff(window, axis=1) ** 2).sum()))
    assert int(np.argmax(sharpness)) == offsets.index(0.0)
    assert sharpness[2] > 2 * sharpness[0]


def test_the_peg_hides_what_is_behind_it_and_nothing_else() -> None:
    rig = twin.build(1, start=twin.Start(100.0, 0.0, 0.0, 3900.0), misalignment=twin.Misalignment.none())
    image, time_s = noiseless(rig, 1)
    corners = rig.world.corners_px(1, "peg", time_s)
    (left, top), (right, bottom) = np.rint(corners[0]).astype(int), np.rint(corners[2]).astype(int)
    moved_hole = twin.build(
        1, start=twin.Start(-100.0, 50.0, 0.05, 3600.0), misalignment=twin.Misalignment.none()
    )
    other, _ = noiseless(moved_hole, 1)
    inside = (slice(top + 4, bottom - 3), slice(left + 4, right - 3))
    # What leaks in is the tail of the in-focus edge, lambda N/(pi^2 X) = 0.012 of it at X = 4 px, per side.
    assert np.abs(image - other)[inside].max() < 0.012
    assert np.abs(image - other)[:, : left - 10].max() > 0.1


def test_camera_2_sees_the_pegs_side_only_down_to_the_plates_rim() -> None:
    start = twin.Start(0.0, 0.0, 0.0, 3900.0)
    rig = twin.build(1, start=start, misalignment=twin.Misalignment.none())
    world = rig.world
    far = world._painted_peg(2, world.hole_pose(), world.peg_pose())
    assert far.high_um[0] == pytest.approx(225 + 300 * math.tan(rig.design.tilt_rad), abs=4.0)
    rig.coarse.move_to({"z": -3900.0})
    rig.coarse.wait_until_still()
    near = world._painted_peg(2, world.hole_pose(), world.peg_pose())
    assert near.high_um[0] == pytest.approx(325.0, abs=4.0)
    assert world._painted_peg(1, world.hole_pose(), world.peg_pose()).high_um[0] == 225.0


# ---- noise and repetition ---------------------------------------------------------------------------------


def test_noise_follows_photon_statistics() -> None:
    rig = twin.build(4)
    design = rig.design
    frames = np.stack([rig.camera_1.grab().pixels.astype(np.float64) for _ in range(40)])
    mean, variance = frames.mean(axis=0), frames.var(axis=0, ddof=1)
    gain = 255 / design.full_well_e
    for low, high in [(60, 90), (110, 140)]:
        chosen = (mean > low) & (mean < high)
        expected = gain * mean[chosen] + (gain * design.read_noise_e) ** 2 + 1 / 12
        ratio = variance[chosen].mean() / expected.mean()
        # A variance from 40 samples has a relative error of sqrt(2/39); chosen pixels average it.
        assert chosen.sum() > 300
        assert ratio == pytest.approx(1, abs=5 * math.sqrt(2 / 39 / chosen.sum()) + 0.01)


def test_a_normal_exposure_neither_saturates_nor_drowns() -> None:
    rig = twin.build(2)
    show(rig, Mask(0.0, -rig.world.psi_rad(1, "hole")))
    for camera in (rig.camera_1, rig.camera_2):
        pixels = camera.grab().pixels
        assert pixels.max() < 250
        assert pixels.min() > 2


def test_the_same_seed_gives_the_same_frames_and_another_seed_others() -> None:
    def run(seed: int) -> list[NDArray[np.uint8]]:
        rig = twin.build(seed)
        rig.slm.show(codes(Mask(20.0)))
        rig.coarse.set_velocity({"z": -500.0, "theta": 0.01})
        return [camera.grab().pixels for camera in (rig.camera_1, rig.camera_2, rig.camera_1)]

    one, again, other = run(7), run(7), run(8)
    for a, b, c in zip(one, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert (a != c).any()


def test_noise_differs_between_seeds_cameras_and_exposures() -> None:
    fields = []
    for seed in (7, 8):
        rig = twin.build(seed)
        corner = ((0, 0), (120, 60))  # background alone
        for camera in (rig.camera_1, rig.camera_2):
            camera.set_region(*corner)
            fields += [camera.grab().pixels.astype(np.float64) for _ in range(2)]
    correlation = np.corrcoef(np.stack(fields).reshape(len(fields), -1)) - np.eye(len(fields))
    # Six standard errors of a correlation over 7200 pixels.
    assert np.abs(correlation).max() < 6 / math.sqrt(7200)


# ---- touching ---------------------------------------------------------------------------------------------


def approach(start: twin.Start, down_to_um: float) -> twin.World:
    rig = twin.build(0, start=start, misalignment=twin.Misalignment.none())
    rig.coarse.move_to({"z": down_to_um - start.depth_um})
    rig.coarse.wait_until_still()
    return rig.world


@pytest.mark.parametrize(
    ("x_um", "y_um", "theta_deg", "down_to_um", "touches"),
    [
        (0.0, 0.0, 0.0, 0.0, False),
        (99.0, 49.0, 0.0, 0.0, False),
        (101.0, 0.0, 0.0, 0.0, True),
        (0.0, -51.0, 0.0, 0.0, True),
        (101.0, 0.0, 0.0, 301.0, False),
        (101.0, 0.0, 0.0, 299.0, True),
        (95.0, 45.0, 3.0, 0.0, True),
        (0.0, 0.0, 5.0, 0.0, False),
        (0.0, 0.0, -5.0, 0.0, False),
    ],
)
def test_solids_touch_exactly_when_they_overlap(
    x_um: float, y_um: float, theta_deg: float, down_to_um: float, touches: bool
) -> None:
    world = approach(twin.Start(x_um, y_um, math.radians(theta_deg), 3900.0), down_to_um)
    assert world.contact() is touches
    assert world.truth().contact is touches
    assert (len(world.contacts) == 1) is touches
    assert world.truth().inserted is (not touches and down_to_um < 300)


def test_a_contact_is_recorded_when_it_begins_even_if_it_has_ended() -> None:
    rig = twin.build(0, start=twin.Start(150.0, 0.0, 0.0, 3900.0), misalignment=twin.Misalignment.none())
    began_s = rig.clock.now_s + rig.coarse.latency_s
    rig.coarse.move_to({"z": -3700.0})
    rig.coarse.wait_until_still()
    rig.coarse.move_to({"z": -3000.0})
    rig.coarse.wait_until_still()
    (contact,) = rig.world.contacts
    assert not rig.world.contact()
    # 1 mm/s over 3600 um; watched every millisecond.
    assert contact.time_s == pytest.approx(began_s + 3.6, abs=2e-3)
    assert contact.depth_um == pytest.approx(300.0, abs=2.0)
    assert contact.offset_um[0] == pytest.approx(150.0, abs=1e-9)


def test_the_truth_of_an_earlier_moment_stays_known() -> None:
    rig = twin.build(6)
    before = rig.world.truth()
    rig.coarse.move_to({"x": 300.0, "theta": 0.05, "z": -1000.0})
    rig.coarse.wait_until_still()
    assert rig.world.truth(before.time_s) == before
    assert rig.world.truth().depth_um == pytest.approx(before.depth_um - 1000, abs=0.1)
    assert rig.world.truth().offset_rad == pytest.approx(before.offset_rad + 0.05, abs=16e-6)


def test_turning_the_hole_about_a_hidden_centre_also_moves_it() -> None:
    rig = twin.build(6)
    before = rig.world.truth()
    rig.coarse.move_to({"theta": 0.1})
    rig.coarse.wait_until_still()
    after = rig.world.truth()
    moved_um = math.hypot(after.offset_um[0] - before.offset_um[0], after.offset_um[1] - before.offset_um[1])
    arm = rig.world._secret.arm_um
    assert moved_um == pytest.approx(2 * math.sin(0.05) * float(np.hypot(*arm)), rel=1e-3)


def test_frames_of_a_moving_hole_agree_with_rendering_it_afresh() -> None:
    moving = twin.build(9)
    for target in ({"x": 30.0}, {"theta": 0.02, "z": -400.0}, {"theta": 0.02, "x": -60.0}):
        moving.coarse.move_to(target)
        moving.coarse.wait_until_still()
        noiseless(moving, 1)
    image, _ = noiseless(moving, 1)
    fresh = twin.build(9)
    fresh.coarse.move_to(moving.coarse.position())
    fresh.coarse.wait_until_still()
    again, _ = noiseless(fresh, 1)
    np.testing.assert_array_equal(image, again)
