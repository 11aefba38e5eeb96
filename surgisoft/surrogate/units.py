"""Units of pressure."""

KPA_PER = {
    "Pa": 1e-3,
    "hPa": 0.1,
    "kPa": 1.0,
    "MPa": 1e3,
    "mbar": 0.1,
    "bar": 100.0,
    "psi": 6.894757293168361,  # 0.45359237 kg * 9.80665 m/s2 / (0.0254 m)^2, NIST SP 811 (2008) B.8
    "atm": 101.325,  # NIST SP 811 (2008) B.8
    "mmHg": 0.133322387415,  # 13595.1 kg/m3 * 9.80665 m/s2 * 1 mm, NIST SP 811 (2008) B.8
}
"""kPa in each unit of pressure."""
