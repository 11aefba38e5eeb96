"""Small experiments as files: a few steps on the liver phantom."""

from pathlib import Path

from surgisoft.scene.spec import PHANTOM

TINY = """
name = "tiny"
scene = "{scene}"
seed = 3
repeats = 3
together = 1

[limits]
time_s = 0.5

[task]
fire_mm = 50.0

[[phases]]
name = "look"
endoscope = "policy"
until = "centred"
timeout_s = 0.3
on_timeout = "go on"

[[phases]]
name = "cut"
laser = "policy"
endoscope = "policy"
beam = true
until = "cut"
timeout_s = 30.0
"""

FAULT = """
[[faults]]
arm = "endoscope"
chamber = 3
at_s = 1.7
"""

BREATHING = """
name = "breaths"
scenario = "breathing_ablation"
scene = "{scene}"

[[phases]]
name = "cut"
laser = "policy"
beam = true
timeout_s = 30.0
"""


def write(folder: Path, text: str = TINY, name: str = "tiny.toml") -> Path:
    """The experiment's file in a folder, its scene the liver phantom."""
    path = folder / name
    path.write_text(text.replace("{scene}", str(PHANTOM)))
    return path
