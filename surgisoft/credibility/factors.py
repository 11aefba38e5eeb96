"""The credibility factors of ASME V&V 40-2018 (section 5), and what a report says about each.

The standard asks for a goal of each factor that fits the model risk. The goals are the user's; the
report states the evidence, or that it has none.
"""

from dataclasses import asdict, dataclass

from surgisoft.credibility.assessment import Assessment
from surgisoft.credibility.software import COMMIT

NOT_ASSESSED = "not assessed"
"""Begin of what is said of a factor for which a report has no evidence."""


UNCERTAIN = "Parts of the validation uncertainty"
"""Section of the parts of U_val."""


@dataclass(frozen=True)
class Factor:
    """One credibility factor."""

    activity: str
    """The activity that the standard lists it under."""
    name: str
    """Its name in the standard."""
    evidence: str
    """What the report says about it."""
    section: str
    """The section of the report with the numbers; empty where there is none."""

    @property
    def assessed(self) -> bool:
        """Whether the report has evidence."""
        return not self.evidence.startswith(NOT_ASSESSED)

    def to_json(self) -> dict:
        """Plain values."""
        return asdict(self) | {"assessed": self.assessed}


def factors(found: Assessment) -> tuple[Factor, ...]:
    """The thirteen factors in the order of the standard, for one assessment."""
    code, calculation = "verification: code", "verification: calculation"
    model, comparator = "validation: computational model", "validation: comparator"
    assessment, use = "validation: assessment", "applicability"
    parts, body = found.uncertainty.body, found.points[-1]
    robots = {each.robot for each in found.comparators} - {""}
    stated = f"{len(robots)} stated" if robots else "none stated"
    equal = [each.equivalent for each in found.inputs]
    form = f"{NOT_ASSESSED}: {found.no_diagnosis}"
    if found.diagnosis is not None:
        form = found.diagnosis.verdict.sentence
    agreement = f"{NOT_ASSESSED}: no episode of the scenario to check with the exact checker"
    if found.agreement is not None:
        agreement = found.agreement.sentence
    steps = _part("u_num", parts.numerical_mm)
    if parts.numerical_mm is None:
        steps = f"{NOT_ASSESSED}: {steps}"
    domain = f"{NOT_ASSESSED}: no states of the scenario are given"
    if found.applicability is not None:
        domain = found.applicability.sentence
    stated_of = "versions and commit" if COMMIT in found.software else "versions"
    versions = (
        f"{stated_of} are stated; the source code comes with its tests, their branch coverage and "
        "their mutation tests"
    )
    return (
        Factor(code, "software quality assurance", versions, "Software"),
        Factor(code, "numerical code verification", agreement, "Software"),
        Factor(calculation, "discretization error", steps, UNCERTAIN),
        Factor(calculation, "numerical solver error", NOT_ASSESSED, ""),
        Factor(
            calculation,
            "use error",
            f"{NOT_ASSESSED}: hashes of the recordings and versions allow a repetition",
            "Comparators",
        ),
        Factor(model, "model form", form, "Model form"),
        Factor(
            model,
            "model inputs",
            f"{_part('u_input', parts.input_mm)}; {_part('u_parameters', parts.parameters_mm)}",
            UNCERTAIN,
        ),
        Factor(
            comparator,
            "test samples",
            f"recordings: {len(found.comparators)}; robots: {stated}",
            "Comparators",
        ),
        Factor(
            comparator,
            "test conditions",
            "ranges of actuation, rows and dates of each recording; measurement noise: "
            + _part("u_D", parts.noise_mm),
            "Comparators",
        ),
        Factor(
            assessment,
            "equivalency of input parameters",
            f"equivalent {equal.count(True)}, not equivalent {equal.count(False)}, not known "
            f"{equal.count(None)} of {len(equal)} inputs",
            "Equivalence of inputs",
        ),
        Factor(
            assessment,
            "output comparison",
            f"of the body: E {body.error_mm:.3g} mm, U_val {body.uncertainty_mm:.3g} mm, area "
            f"metric {body.area_mm:.3g} mm",
            "Comparison error and validation uncertainty",
        ),
        Factor(
            use,
            "relevance of the quantities of interest",
            f"{NOT_ASSESSED}: positions of key points are compared; whether they answer the "
            "question of interest is for the user to judge",
            "",
        ),
        Factor(
            use,
            "relevance of the validation activities to the context of use",
            domain,
            "Applicability",
        ),
    )


def _part(name: str, value_mm: float | None) -> str:
    return f"{name} not known" if value_mm is None else f"{name} {value_mm:.3g} mm"
