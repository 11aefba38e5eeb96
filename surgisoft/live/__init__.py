"""Closed loop on a rig with a model beside it: a fixed rate, a log, a live view, a change detector.

`run` drives a rig by a policy or a schedule; `change` decides when the model is no longer valid;
`clock` keeps and measures the rate; `watch` is the rig as the loop sees it, which records, predicts
and shows every sample.
"""
