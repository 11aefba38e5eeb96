"""Effects injected into recordings of real robots: what a rod would have moved is added to them.

Noise, drift of the cameras and the model's error stay those of the real recording. The rod and the
laws of the effects share no formula with the effects of an arm model, except where physics leaves
one form only; `laws` says where.
"""
