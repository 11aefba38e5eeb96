"""A sixth generator of robots: a Kirchhoff rod whose strains are polynomials along the arm."""
