"""An eighth generator of robots: arms in MuJoCo that tendons bend (Todorov et al. 2012)."""
