"""Claims: without faults the machine equals the reference, and the claims of the thesis are visible."""

import json

import numpy as np
import pytest

from docs.experiments import claims
from docs.experiments.claims import Faults, beacons, draw_claims, draw_frames, machine_of, run_claims
from machines.bm1 import Start, addressed_codes
from machines.reference import ReferenceBM1
from toolchain.analysis.emulation import sample_readings


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(claims, "FAULT_CYCLES", 1024)
    model = beacons(6, 3)
    return model, machine_of(model, counter_bits=8)


def test_without_faults_it_is_the_reference(small):
    model, machine = small
    readings = sample_readings(model, 4, seed=1)
    faults = Faults(machine, seed=1)
    for frame in range(4):
        addresses, _ = readings.of_machine(frame, machine)
        for target in (20, 255):
            start = Start(addresses=addresses, target_count=target, max_cycles=1024, bank=frame)
            kernel = ReferenceBM1(machine)
            kernel.start(start)
            counts, cycles = faults.counts(addressed_codes(machine, start), bank=frame, target_count=target)
            assert counts.tolist() == kernel.counts.tolist()
            assert cycles == kernel.cycles


def test_flips_happen_as_often_as_asked_for(small):
    faults = Faults(small[1], seed=1)
    words = np.zeros(4000, dtype=np.uint16)
    flipped = faults.flipped(words, 8, 0.25)
    assert int(flipped.max()) < 256
    assert np.bitwise_count(flipped).sum() / 32_000 == pytest.approx(0.25, abs=0.015)
    assert (faults.flipped(words, 8, 0.0) == 0).all()


def test_products_without_faults_are_exact_inference(small):
    model, machine = small
    faults = Faults(machine, seed=1)
    for frame, exact in zip(*draw_frames(model, machine, 3, seed=1), strict=True):
        assert faults.floating_point(frame, 0.0) == pytest.approx(exact, abs=1e-5)
        assert 0.5 * np.abs(faults.fixed_point(frame, 0.0) - exact).sum() < 0.05


def test_the_claims(monkeypatch, tmp_path):
    monkeypatch.setattr(claims, "GRIDS", (8, 16, 32))
    monkeypatch.setattr(claims, "SENSORS", (2, 5, 8))
    monkeypatch.setattr(claims, "TARGETS", (31, 255))
    monkeypatch.setattr(claims, "RATES", (0.0, 0.01))
    monkeypatch.setattr(claims, "FAULT_CYCLES", 1024)
    monkeypatch.setattr(claims, "FAULT_FRAMES", 6)
    told = []
    found = run_claims(frames=60, seed=2, advance=told.append)
    assert len(told) == claims.experiments() == 3 + 3 + 2 + 5 * 2
    by_lines = [cycles.value for cycles in found.lines.values()]
    assert max(by_lines) < 1.6 * min(by_lines)  # while the number of lines grows 16 times
    by_sensors = [cycles.value for cycles in found.sensors.values()]
    assert by_sensors == sorted(by_sensors)
    assert by_sensors[-1] > 3 * by_sensors[0]
    assert found.targets[255].value > 6 * found.targets[31].value
    worse = {name: faults[0.01].value - faults[0.0].value for name, faults in found.faults.items()}
    assert worse["machine: stream bits"] < worse["8-bit fixed point"] < worse["32-bit floating point"]
    assert abs(worse["machine: bits of random numbers"]) < 0.05
    assert json.loads(found.as_json())["seed"] == 2
    assert found.as_text().startswith("Cycles by the number of lines")
    draw_claims(tmp_path / "claims.png", found)
    assert (tmp_path / "claims.png").read_bytes().startswith(b"\x89PNG")
