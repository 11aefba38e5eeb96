"""Scripted experiments on a scene: phases, cases, what varies, limits; tables, replays, a report.

`task` says what a task has to offer for experiments, `ablation` offers it for `circle_ablation`.
`spec` is the file, `phases` the task with phases and interlock, `controllers` who moves each arm,
`plan` the settings that the file asks for, `run` rolls them out, `results` summarises, `page` and
`pictures` show.
"""
