"""Credibility of a model for a stated use, in the terms of ASME V&V 40-2018 and V&V 20-2009.

`context` reads what the user states, `metrics` compares numbers, `uncertainty` finds what may
differ without a fault of the model, `retest` compares recordings with each other, `domain` finds
where a scenario leaves what was validated, `scenario` takes an experiment's results, `software`
states what computed it, `assessment` puts all together and `page` shows it. The result is in a form
usable for such an assessment; it is no statement of compliance.
"""
