"""Published upper limits: what the abstracts say, what is near a redshift, and tables that are none."""

from __future__ import annotations

import numpy as np
import pytest

from calstudy.base.errors import InputError
from calstudy.figures.spherical import Spherical
from calstudy.power.limits import Limits, limits_near, published_limits, read_limits

HEADING = "name,reference,z,k,delta2\n"


@pytest.mark.parametrize(
    ("name", "z", "k", "delta2"),
    [
        ("HERA 2023, field C", 7.9, 0.34, 457),
        ("HERA 2023, field D", 10.4, 0.36, 3496),
        ("Mertens et al. 2025", 8.3, 0.083, 65.5**2),
        ("Mertens et al. 2025", 9.1, 0.076, 54.3**2),
        ("Mertens et al. 2025", 10.1, 0.076, 68.7**2),
        ("Nunhokee et al. 2025", 6.5, 0.18, 30.2**2),
        ("Nunhokee et al. 2025", 6.8, 0.18, 31.2**2),
        ("Nunhokee et al. 2025", 7.0, 0.21, 39.1**2),
        ("Trott et al. 2020", 6.5, 0.14, 1.8e3),
    ],
)
def test_the_deepest_limits_are_those_of_the_abstracts(name, z, k, delta2):
    (found,) = (limits for limits in read_limits(published_limits()) if (limits.name, limits.redshift) == (name, z))
    lowest = found.delta2.argmin()
    # Abstracts round to two digits, Trott et al. (43 mK)^2 down.
    assert found.k[lowest] == pytest.approx(k, abs=0.005)
    assert found.delta2[lowest] == pytest.approx(delta2, rel=0.035)
    assert (np.diff(found.k) > 0).all()
    assert found.reference.startswith(("arXiv:", "doi:"))


def test_power_of_a_limit_has_its_variance_per_logarithm_of_k():
    k = np.array([0.1, 0.5])
    found = Limits("any", "any", 7.0, k, np.array([100.0, 100.0]))
    np.testing.assert_allclose(4 * np.pi * k**3 * found.power / (2 * np.pi) ** 3, found.delta2, rtol=1e-12)


def test_each_name_has_its_closest_redshift_if_that_is_near():
    made = [Limits(name, "", z, np.ones(1), np.ones(1)) for name, z in (("a", 6.5), ("a", 7.0), ("b", 7.6), ("b", 8.0))]
    assert [(each.name, each.redshift) for each in limits_near(made, 6.8)] == [("a", 7.0)]
    assert [(each.name, each.redshift) for each in limits_near(made, 7.3)] == [("a", 7.0), ("b", 7.6)]
    assert not limits_near(made, 12.0)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("name,z,k\n", "has no column reference, delta2; it needs name, reference, z, k, delta2"),
        (f"{HEADING}a,b,7,0.2,-3\n", "line 2: delta2 = '-3' is not a positive number"),
        (f"{HEADING}a,b,7,0.2,10\na,b,7,,10\n", "line 3: k = '' is not a positive number"),
        (f"{HEADING}a,b,7\n", "line 2: k = None is not a positive number"),
    ],
)
def test_what_is_no_table_of_limits_says_why(tmp_path, text, told):
    path = tmp_path / "limits.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_limits(path)
    assert str(caught.value).endswith(told)
    with pytest.raises(InputError, match="cannot be read as a table of limits"):
        read_limits(tmp_path)


def test_the_published_table_has_a_name_in_files_and_counts_by_its_content():
    figure = Spherical(limits="published")
    assert figure.limits == published_limits()
    assert figure.model_dump(mode="json")["limits"] == "published"
    assert "Trott et al. 2020 (doi:10.1093/mnras/staa414)" in figure.captioned()
    assert Spherical().captioned() == Spherical.caption
