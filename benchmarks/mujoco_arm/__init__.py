"""A fifth generator of robots: a soft pneumatic arm in MuJoCo (Todorov et al. 2012)."""
