from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adof_cl import reference
from adof_cl.device import Device
from adof_cl.errors import InputError, LimitError
from adof_cl.optics import Mask, OpticalSystem, SlmPanel
from adof_cl.slm_encode import PANELS, SlmEncode, panel_named, stroke_table

OPTICS = OpticalSystem()


def panel(rows: int, columns: int, stroke_rad: float = 2 * math.pi) -> SlmPanel:
    return SlmPanel(
        "test", rows, columns, pitch_um=100.0, fill_factor=1.0, frame_rate_hz=60.0, stroke_rad=stroke_rad
    )


def level_difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Codes apart around the turn, on a full stroke: code 255 is a whole turn, the phase of code 0."""
    difference = np.abs(a.astype(int) - b.astype(int))
    return np.minimum(difference, 255 - difference)


@pytest.mark.parametrize("name", ["LC2002", "LC2012"])
def test_codes_equal_the_references_but_for_rare_single_levels(
    device: Device, precision: str, name: str
) -> None:
    mask = Mask(53.5, -20.0)
    codes = SlmEncode(device, PANELS[name], OPTICS, precision=precision).codes(mask)
    stop_px = PANELS[name].stop_px(OPTICS.aperture_um)
    expected = reference.slm_encode(codes.shape, stop_px, stroke_table(2 * math.pi), 53.5, -20.0)
    differing = level_difference(codes, expected)
    # A phase error of 4e-7 rad crosses a level's edge in 2 * 256 * 4e-7/(2 pi) = 3e-5 of the pixels.
    assert differing.max() <= 1
    assert np.count_nonzero(differing) <= 1e-4 * codes.size


@settings(max_examples=25)
@given(
    rows=st.integers(1, 40),
    columns=st.integers(1, 40),
    across=st.floats(0.3, 40),
    alpha=st.floats(-3, 3),
    psi=st.floats(-3, 3),
)
def test_any_panel_and_stop_encode_or_are_refused(
    device: Device, rows: int, columns: int, across: float, alpha: float, psi: float
) -> None:
    optics = OpticalSystem(aperture_um=across * 100.0)
    chosen = panel(rows, columns)
    mask = Mask(alpha, psi)
    if chosen.stop_px(optics.aperture_um) > min(rows, columns):
        with pytest.raises(LimitError, match="use a stop of at most"):
            SlmEncode(device, chosen, optics)
        return
    encode = SlmEncode(device, chosen, optics)
    if encode.step_rad(mask) > math.pi:
        with pytest.raises(LimitError, match="more than pi"):
            encode(mask)
        return
    expected = reference.slm_encode(
        (rows, columns), chosen.stop_px(optics.aperture_um), stroke_table(2 * math.pi), alpha, psi
    )
    assert level_difference(encode.codes(mask), expected).max() <= 1


def test_codes_are_zero_on_every_pixel_the_stop_does_not_uncover(device: Device) -> None:
    optics = OpticalSystem(aperture_um=1050.0)  # 10.5 of 20 pixels: it touches 12
    table = np.full(256, 7, np.uint8)
    codes = SlmEncode(device, panel(20, 24), optics, table=table).codes(Mask(2.0))
    assert np.flatnonzero(codes.any(axis=1)).tolist() == list(range(4, 16))
    assert np.flatnonzero(codes.any(axis=0)).tolist() == list(range(6, 18))


def test_a_correction_adds_modulo_a_turn(device: Device) -> None:
    optics, mask = OpticalSystem(aperture_um=2000.0), Mask(3.0, 1.0)
    flat = SlmEncode(device, panel(20, 20), optics).codes(mask)
    for turns, levels in ((0.5, 128), (7.25, 64), (-1.0, 0)):
        correction = np.full((20, 20), 2 * math.pi * turns)
        shifted = SlmEncode(device, panel(20, 20), optics, correction_rad=correction).codes(mask)
        back = (np.arange(256) - levels) % 256
        # Codes run from 0 to 255 over a full turn of levels: neighbours may merge.
        assert level_difference(back[shifted], flat).max() <= 1


def test_a_positive_cubic_rises_towards_positive_x_and_y(device: Device) -> None:
    optics = OpticalSystem(aperture_um=2000.0)
    codes = SlmEncode(device, panel(20, 20), optics).codes(Mask(2.0)).astype(int)
    assert codes[10, 19] > codes[10, 10]
    assert codes[19, 10] > codes[10, 10]
    tilted = SlmEncode(device, panel(20, 20), optics).codes(Mask(), tilt_xy_rad=(2.0, 0.0)).astype(int)
    assert tilted[10, 19] > tilted[10, 11]
    assert np.array_equal(tilted[0], tilted[19])


@given(stroke=st.floats(0.2, 2 * math.pi))
def test_a_short_stroke_shows_the_nearest_phase_it_can(stroke: float) -> None:
    table = stroke_table(stroke)
    wanted = 2 * math.pi * np.arange(256) / 256
    shown = table.astype(float) / 255 * stroke
    error = np.abs(shown - wanted)
    error = np.minimum(error, 2 * math.pi - error)
    every = np.arange(256) / 255 * stroke
    best = np.abs(every[None, :] - wanted[:, None])
    best = np.minimum(best, 2 * math.pi - best).min(axis=1)
    assert np.all(error <= best + 1e-12)
    # At most what the missing part of the stroke leaves, or half a code: docs/maths.md eq. E3.
    assert error.max() <= max(math.pi - stroke / 2, stroke / 255 / 2) + 1e-12


def test_a_measured_table_is_used_as_it_is(device: Device) -> None:
    optics = OpticalSystem(aperture_um=2000.0)
    plain = SlmEncode(device, panel(20, 20), optics, table=np.arange(256, dtype=np.uint8)).codes(Mask(5.0))
    turned = SlmEncode(device, panel(20, 20), optics, table=np.arange(256, dtype=np.uint8)[::-1].copy())
    assert np.array_equal(turned.codes(Mask(5.0)), 255 - plain)


@pytest.mark.parametrize("name", ["PLUTO", "LETO"])
def test_a_stop_wider_than_the_panel_is_refused_with_the_widest_that_fits(device: Device, name: str) -> None:
    widest = PANELS[name].rows * PANELS[name].pitch_um
    with pytest.raises(LimitError, match=f"at most {widest:g} um"):
        SlmEncode(device, PANELS[name], OPTICS)
    SlmEncode(device, PANELS[name], OpticalSystem(aperture_um=widest))


def test_a_step_beyond_pi_is_refused_and_names_the_limit(device: Device) -> None:
    encode = SlmEncode(device, PANELS["LC2002"], OPTICS)
    strongest = math.pi * 312.5 / 6
    encode(Mask(strongest * 0.999))
    with pytest.raises(LimitError, match=r"more than pi: the cubic alone may reach 164"):
        encode(Mask(strongest * 1.001))
    with pytest.raises(LimitError, match="more than pi"):
        encode(Mask(-100.0, 200.0))
    with pytest.raises(LimitError, match="more than pi"):
        encode(Mask(), tilt_xy_rad=(0.0, -500.0))


def test_a_rough_correction_counts_towards_the_step(device: Device) -> None:
    optics = OpticalSystem(aperture_um=2000.0)
    correction = np.zeros((20, 20))
    correction[:, ::2] = 3.0
    encode = SlmEncode(device, panel(20, 20), optics, correction_rad=correction)
    encode(Mask(0.1))
    with pytest.raises(LimitError, match="more than pi"):
        encode(Mask(1.0))


def test_tables_corrections_and_tilts_that_do_not_fit_are_refused(device: Device) -> None:
    optics, chosen = OpticalSystem(aperture_um=1000.0), panel(20, 20)
    with pytest.raises(InputError, match="table is"):
        SlmEncode(device, chosen, optics, table=np.zeros(255, np.uint8))
    with pytest.raises(InputError, match="correction_rad has shape"):
        SlmEncode(device, chosen, optics, correction_rad=np.zeros((20, 19)))
    with pytest.raises(InputError, match="correction_rad holds NaN"):
        SlmEncode(device, chosen, optics, correction_rad=np.full((20, 20), np.nan))
    with pytest.raises(InputError, match="tilt_xy_rad is"):
        SlmEncode(device, chosen, optics)(Mask(), tilt_xy_rad=(0.0, math.nan))


def test_every_preset_says_where_its_numbers_come_from() -> None:
    assert set(PANELS) == {"LC2002", "LC2012", "PLUTO", "LETO"}
    for name, preset in PANELS.items():
        assert preset.name == name
        assert "memory" in preset.source or "public driver" in preset.source
        assert "stroke" in preset.source
    assert panel_named("lc 2012") is PANELS["LC2012"]
    with pytest.raises(InputError, match="choose one of LC2002"):
        panel_named("GAEA")
