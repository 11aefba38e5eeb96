"""Scripted experiments with any task: phases, cases, variations and limits; tables and a report.

What a task offers to experiments stands in its `TaskSpec` (`surgisoft.tasks.supervision`). `spec`
is the file, `phases` the task with phases and interlock, `controllers` the controllers of each arm,
`plan` the settings that the file asks for, `run` rolls them out, `results` summarises, `page` and
`pictures` present.
"""
