"""Scripted experiments on a scene: phases, cases, variations and limits; tables and a report.

`task` defines what a task has to offer for experiments, `ablation` offers it for `circle_ablation`.
`spec` is the file, `phases` the task with phases and interlock, `controllers` the controllers of
each arm, `plan` the settings that the file asks for, `run` rolls them out, `results` summarises,
`page` and `pictures` present.
"""
