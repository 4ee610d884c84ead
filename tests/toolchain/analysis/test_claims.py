"""Claims: without faults the machine equals the reference, and the claims of the thesis are visible."""

import json

import numpy as np
import pytest

from machines.bm1 import Start, addressed_codes
from machines.reference import ReferenceBM1
from toolchain.analysis import claims
from toolchain.analysis.claims import KINDS, Faults, FaultyMachine, beacons, frames_of, machine_of, run_claims
from toolchain.analysis.pictures import draw_claims
from toolchain.analysis.readings import sample_readings
from toolchain.models.model import exact_posterior


@pytest.fixture(scope="module")
def small():
    model = beacons(6, 3)
    return model, machine_of(model, counter_bits=8)


def test_without_faults_it_is_the_reference(small):
    model, machine = small
    readings = sample_readings(model, 4, seed=1)
    faulty = FaultyMachine(machine, seed=1)
    for frame in range(4):
        addresses, _ = readings.of_machine(frame, machine)
        for target, limit in ((20, 3000), (255, 700)):
            start = Start(addresses=addresses, target_count=target, max_cycles=limit, bank=frame)
            kernel = ReferenceBM1(machine)
            kernel.start(start)
            counts, cycles = faulty.counts(
                addressed_codes(machine, start), bank=frame, target_count=target, max_cycles=limit
            )
            assert counts.tolist() == kernel.counts.tolist()
            assert cycles == kernel.cycles


def test_flips_happen_as_often_as_asked_for():
    words = np.zeros(4000, dtype=np.uint16)
    flipped = claims._flipped(words, 8, 0.25, np.random.default_rng(1))
    assert int(flipped.max()) < 256
    assert np.bitwise_count(flipped).sum() / 32_000 == pytest.approx(0.25, abs=0.015)
    assert (claims._flipped(words, 8, 0.0, np.random.default_rng(1)) == 0).all()


def test_every_kind_of_fault_changes_something(small):
    model, machine = small
    (frame,) = frames_of(model, machine, sample_readings(model, 1, seed=1))
    for name, kind in KINDS.items():
        whole, torn = (kind(Faults(machine, seed=1), frame, rate) for rate in (0.0, 0.05))
        assert whole.sum() == pytest.approx(1), name
        assert torn is None or not np.array_equal(whole, torn), name


def test_products_without_faults_are_exact_inference(small):
    model, machine = small
    readings = sample_readings(model, 3, seed=1)
    for at, frame in enumerate(frames_of(model, machine, readings)):
        exact = exact_posterior(model, readings.of_model(at)[0])
        faults = Faults(machine, seed=1)
        assert faults.floating_point(frame, 0.0) == pytest.approx(exact, abs=1e-5)
        assert 0.5 * np.abs(faults.fixed_point(frame, 0.0) - exact).sum() < 0.05


def test_the_claims(monkeypatch, tmp_path):
    monkeypatch.setattr(claims, "GRIDS", (8, 16, 32))
    monkeypatch.setattr(claims, "SENSORS", (2, 5, 8))
    monkeypatch.setattr(claims, "TARGETS", (31, 255))
    monkeypatch.setattr(claims, "RATES", (0.0, 0.01))
    monkeypatch.setattr(claims, "_FAULT_CYCLES", 1024)
    monkeypatch.setattr(claims, "FAULT_FRAMES", 6)
    told = []
    found = run_claims(frames=60, seed=2, advance=told.append)
    assert len(told) == claims.experiments() == 3 + 3 + 2 + 5 * 2
    by_lines = [course.median for course in found.lines]
    assert max(by_lines) < 1.6 * min(by_lines)  # while the number of lines grows 16 times
    by_sensors = [course.median for course in found.sensors]
    assert by_sensors == sorted(by_sensors)
    assert by_sensors[-1] > 3 * by_sensors[0]
    assert found.targets[1].median > 6 * found.targets[0].median
    worse = {
        name: faults[1].total_variation - faults[0].total_variation for name, faults in found.faults.items()
    }
    assert worse["machine: stream bits"] < worse["8-bit fixed point"] < worse["32-bit floating point"]
    assert abs(worse["machine: bits of random numbers"]) < 0.05
    assert found.lowest_rate == 0.01
    assert json.loads(found.as_json())["seed"] == 2
    pytest.importorskip("matplotlib")
    draw_claims(tmp_path / "claims.png", found)
    assert (tmp_path / "claims.png").read_bytes().startswith(b"\x89PNG")
