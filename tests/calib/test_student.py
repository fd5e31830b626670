import pytest
from scipy.stats import t

from polecal.calib.student import exceeded


@pytest.mark.parametrize("freedom", [1, 2, 3, 4, 7, 12, 99, 400])
@pytest.mark.parametrize("chance", [0.9, 0.5, 0.05, 1e-3, 1e-6, 1e-9])
def test_it_is_scipys(freedom, chance):
    assert exceeded(chance, freedom) == pytest.approx(t.isf(chance / 2, freedom), rel=3e-7)
