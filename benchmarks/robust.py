"""Benchmark `robust`: `circle_ablation` on rigs of robots that took no part in any training.

Two questions are asked of every method. With the model of the package the rig is another robot of
the same make; with a model of the robot itself a lab has recorded ten minutes of that robot and
fitted a model to them, as `surgisoft fit` does. Hidden effects are then switched on one at a time,
which no model has.

Every case, one robot with one method, is a file in the folder of the study: an interrupted study
goes on where it stopped.
"""

from __future__ import annotations
