"""What tissue takes to be ablated: the blow-off model and the numbers of liver."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from surgisoft.errors import InputError

LIVER_WATER = 0.745
"""Mass fraction of water in liver (Woodard & White 1986, Br. J. Radiol. 59:1209, 'liver 2')."""
LIVER_DENSITY_G_PER_MM3 = 1.06e-3
"""Density of liver (Woodard & White 1986, the same table)."""
WATER_HEAT_J_PER_G_K = 4.18
"""Specific heat of water (CRC Handbook of Chemistry and Physics)."""
WATER_VAPORISATION_J_PER_G = 2257.0
"""Latent heat of water at 100 degrees C (CRC Handbook of Chemistry and Physics)."""
BODY_C = 37.0
"""Temperature of the tissue before (degrees C)."""


def vaporisation_j_per_mm3() -> float:
    """Energy (J/mm^3) that heats liver's water to 100 degrees C and vaporises all of it."""
    per_gram = WATER_HEAT_J_PER_G_K * (100.0 - BODY_C) + WATER_VAPORISATION_J_PER_G
    return LIVER_WATER * LIVER_DENSITY_G_PER_MM3 * per_gram


@dataclass(frozen=True)
class Tissue:
    """The blow-off model's two numbers (Vogel & Venugopalan 2003, Chem. Rev. 103:577, VII.A.1).

    Light falls off as Phi exp(-mu z); what absorbs more than the ablation enthalpy per volume
    goes. So ablation starts at Phi_th = h / mu and reaches ln(Phi / Phi_th) / mu deep. With h of
    full vaporisation Phi_th at 2010 nm is 43 J/cm^2; measured on fresh liver: 29 J/cm^2 (Nishioka
    & Domankevitz 1990, IEEE J. Quantum Electron. 26:2271).
    """

    absorption_per_mm: float = 9.0
    """Absorption mu of the tissue at the laser's wavelength (1/mm)."""
    enthalpy_j_per_mm3: float = vaporisation_j_per_mm3()
    """Ablation enthalpy h per volume (J/mm^3)."""

    def __post_init__(self):
        for name in ("absorption_per_mm", "enthalpy_j_per_mm3"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"tissue {name} is {getattr(self, name)}: expected more than 0")

    @property
    def threshold_j_per_mm2(self) -> float:
        """Radiant exposure at which ablation starts (J/mm^2)."""
        return self.enthalpy_j_per_mm3 / self.absorption_per_mm

    def depth_mm(self, dose_j_per_mm2: torch.Tensor) -> torch.Tensor:
        """Ablated depth (mm) after doses (J/mm^2)."""
        ratio = dose_j_per_mm2 / self.threshold_j_per_mm2
        return ratio.clamp(min=1.0).log() / self.absorption_per_mm

    def dose_for_depth(self, depth_mm: float) -> float:
        """Dose (J/mm^2) that ablates to a depth (mm)."""
        return self.threshold_j_per_mm2 * math.exp(self.absorption_per_mm * depth_mm)
