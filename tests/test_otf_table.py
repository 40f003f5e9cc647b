from __future__ import annotations

import numpy as np
import pytest

import tolerances
from adof_cl import reference
from adof_cl.device import Device
from adof_cl.errors import InputError
from adof_cl.optics import Mask, OpticalSystem
from adof_cl.otf_table import OtfTable

OPTICS = OpticalSystem()


@pytest.mark.parametrize("pixel", [True, False])
@pytest.mark.parametrize("shape", [(12, 20), (9, 9), (1, 2), (35, 16)])
def test_each_entry_is_the_outer_product_of_exact_axes(
    device: Device, precision: str, shape: tuple[int, int], pixel: bool
) -> None:
    table = OtfTable(device, OPTICS, shape, entries=2, pixel=pixel, precision=precision)
    mask = Mask(35.0, -40.0)
    depths = (0.0, 3000.0)
    table.update_depths(mask, depths)
    for entry, depth in enumerate(depths):
        psi = OPTICS.psi_rad(depth) - 40.0
        axes = []
        for n in shape:
            h = reference.otf_1d(OPTICS.frequency_axis(n), 35.0, psi)
            h *= OPTICS.pixel_otf_axis(n) if pixel else 1.0
            if n % 2 == 0:
                h[n // 2] = h[n // 2].real
            axes.append(h)
        error = np.abs(table.otf(entry) - np.outer(*axes)).max()
        assert error <= 2 * tolerances.otf_error(precision, 35.0)
        assert np.array_equal(table.out.download()[entry], np.concatenate(table.axes(entry)))
        for n, axis in zip(shape, table.axes(entry), strict=True):
            assert axis[0] == 1
            assert n % 2 or axis[n // 2].imag == 0
            assert np.array_equal(axis[1:], axis[:0:-1].conj())


def test_the_psf_of_an_entry_is_real_sums_to_one_and_is_the_references(device: Device) -> None:
    table = OtfTable(device, OPTICS, (64, 32))
    table.update([(20.0, 10.0)])
    psf = np.fft.ifft2(table.otf(0).astype(np.complex128))
    assert np.abs(psf.imag).max() <= tolerances.eps("float32")
    assert psf.real.sum() == pytest.approx(1, abs=tolerances.otf_error("float32", 20.0))
    axes = table.axes(0)
    expected = reference.psf_of_axes(*[axis.astype(np.complex128) for axis in axes])
    assert np.abs(psf.real - expected).max() <= tolerances.eps("float32")


def test_entries_and_depths_that_do_not_exist_are_refused(device: Device) -> None:
    table = OtfTable(device, OPTICS, (8, 8), entries=2)
    with pytest.raises(InputError, match="pairs has shape"):
        table.update([(1.0, 0.0)])
    with pytest.raises(InputError, match="entry is 2"):
        table.otf(2)
    with pytest.raises(InputError, match="depth_um is nan"):
        table.update_depths(Mask(), [0.0, float("nan")])
