"""Which settings and which values of a bench file have changed since a run began."""

from __future__ import annotations

from rig.run.changed_since import changes

BENCH = 'name = "b"\n[stage_z]\nhost = "10.0.0.5"\nport = 502\n[fixture.parked]\nz_mm = 1.0\n'


def test_settings_and_values_of_the_bench_file_are_named_as_they_are_written() -> None:
    settings = {"speed_mm_s": 1.0, "load": {"peak_N": 2.0}, "new": True}
    now = {"speed_mm_s": 2.0, "load": {"peak_N": 2.0}, "tick_Hz": None}
    moved = BENCH.replace("502", "503").replace("z_mm = 1.0", "z_mm = 1.5")
    assert changes(settings, now, BENCH, moved).split("; ") == [
        "speed_mm_s (1.0 then, 2.0 now)",
        "new (True then, not given now)",
        "tick_Hz (not given then, None now)",
        "[stage_z] port of the bench file (502 then, 503 now)",
        "[fixture] parked.z_mm of the bench file (1.0 then, 1.5 now)",
    ]


def test_a_comment_is_a_change_of_the_text_only_and_many_changes_are_counted() -> None:
    assert changes({}, {}, BENCH, f"# moved\n{BENCH}").startswith("the text of the bench file")
    many = changes({f"n_{k}": k for k in range(9)}, {}, BENCH, BENCH)
    assert many.endswith("n_4 (4 then, not given now); 4 further values")
