"""A fourth generator of robots: a lattice of springs around pressurised chambers."""
