"""What `linkax compare` chooses from what it has measured."""

from linkax.studies.sweeps.comparison import Trial, at_equal_cost


def trial(formulation, rtol, error, run_s, verdict="converged"):
    blank = Trial(**dict.fromkeys(Trial._fields, 0.0))
    return blank._replace(formulation=formulation, rtol=rtol, error=error, run_s=run_s, verdict=verdict)


def test_equal_cost_takes_the_most_accurate_run_within_the_budget():
    trials = [trial("a", 10.0**-k, 10.0**-k, 0.01 * k) for k in range(4, 10)]
    (found,) = at_equal_cost(trials, budget_s=0.0701)
    assert found.rtol == 1e-7


def test_equal_cost_takes_no_run_that_diverged():
    trials = [trial("a", 1e-8, 1.0, 0.01, "diverged"), trial("a", 1e-6, 1e-6, 0.02), trial("a", 1e-4, 1e-4, 0.015)]
    (found,) = at_equal_cost(trials, budget_s=0.03)
    assert found.rtol == 1e-6


def test_equal_cost_takes_the_fastest_run_where_none_fits():
    trials = [trial("a", 1e-8, 1e-8, 0.3), trial("b", 1e-8, 1e-3, 0.8, "diverged"), trial("b", 1e-6, 1e-6, 0.9)]
    found = at_equal_cost(trials, budget_s=0.3)
    assert [(t.formulation, t.run_s) for t in found] == [("a", 0.3), ("b", 0.8)]
