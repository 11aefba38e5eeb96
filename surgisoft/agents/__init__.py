"""Policies that act in tasks: untrained and trained ones, training, rollouts and evaluation.

`policies`, `learned` choose actions; `presets`, `ppo`, `training`, `selection`, `run_folder` train;
`rollout`, `exact_checks`, `evaluate`, `report` measure; `on_rig` exchanges the simulated arms for
virtual rigs; `vec_env` and `export` serve other programs.
"""
