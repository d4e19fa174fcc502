"""Where the public household data lie beside the repository; tests that need them skip when they do not."""

from __future__ import annotations

from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[4] / "shared" / "household"
TRIALS = str(DATA / "alfred_json_2.1.0")
OBJECTS = str(DATA / "objects")
LAYOUTS = str(DATA / "layouts")
EPISODES = str(DATA / "robothor" / "val")

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"the public household data are not at {DATA}")
