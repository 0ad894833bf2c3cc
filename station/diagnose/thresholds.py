"""Every threshold that decides something in a diagnosis, with where it comes from.

Tolerances and step lengths of the numerics stand beside their code; what stands here decides what is said.  VARIES
decides in the estimation, too, and stands there with its source.
"""

from station.estimation.noise import VARIES as VARIES

LOG_PRIOR = -4.4
"""Log prior odds that any one further cause is present: even odds that anything is missing, shared among the eighty
or so causes (effects at their places, constants, each of a usual and another sign or angle) that a rig may have."""
LOG_PRIOR_PARAMETER = -2.5
"""Each further parameter of one effect, beside what the evidence itself asks of it: a law that holds a simpler one must
earn its parameters (the odds of one in twelve of a test at 3 sigma among three signs and sizes)."""
OUTSIDE = 0.09
"""Probability beforehand that what acts on a rig is none of the catalogue's causes: of the nine that were found by hand
on three measured rigs (an arm, a geared servo, a linear axis) it holds all; Laplace's rule of succession, (0 + 1)/(9 +
2).  Where more than noise is left the data do not change it."""
WORTH_A_FIT = 2.0
"""Expected fall of -2 ln L from which on a cause is fitted: below the change of Akaike's criterion by one parameter (2)
no set of causes could win."""
CLOSE = 15.0
"""Log posterior odds within which a set is a rival worth fitting to the end: e^-15 is beyond any resample."""
STABLE = 0.8
"""Share of resamples in which a stated cause must be named (the project's own rule)."""
TOLERANCE = 0.1
"""Share of what a cause changes below which what another does not do of it makes the two one to these runs: a variance
inflation factor of ten (Marquardt, Technometrics 12, 1970)."""
SURE = 0.8
"""Probability from which on the leading cause, or what is equivalent to it, stands alone."""
BEYOND = 3.0
"""Sigmas of its stated uncertainty from which on a constant may be accused (the contract)."""
VISIBLE = 25.0
"""Fall of -2 ln L at which an effect of a usual size shows: five sigma, so that among some hundred guesses none shows
by chance."""
NOISE = 6.0
"""z-score of what is left, over runs and channels, beyond which it is no noise: five sigma and one for non-Gaussian
rounding."""
UNSEEN = 1.0
"""Standard errors by which runs left out must be met better with causes than without, where more than noise is left: of
rules that predict alike within the error of the comparison the simpler one is taken (Hastie, Tibshirani and Friedman,
The Elements of Statistical Learning, 2nd ed. 2009, section 7.10)."""
WORSE = 0.95
"""Level at which runs left out are met worse with causes than by re-fitted constants alone (Student's test of pairs,
one-sided): that of all intervals."""
FEW = 3
"""Runs below which even a settled verdict asks for another test."""
PATIENCE = FEW + 1
"""Runs before what the catalogue does not describe is given up: those and one that was chosen to show more."""
SETTLED = 0.95
"""Probability from which on a set of causes has no rival worth a test: the level of all intervals."""
UNLIKELY = 0.01
"""Of the best set's probability: below it a set is no rival that a test is chosen against; one that DECIDES would have
made it as likely at best."""
DECIDES = 9.0
"""chi squared between hypotheses from which on a test is worth running: the odds are expected to move by e^4.5 = 90."""
MENTION = 1.0 / 3.0
"""Odds of a place against the likeliest from which on the first of a law's places is kept: a factor below three is
"not worth more than a bare mention" (Kass and Raftery, J. Am. Stat. Assoc. 90, 1995)."""
SEEN = 0.5
"""Share of the catalogue's effects that would have shown from which on nothing is missing: more than would not."""
BELIEVABLE = 1e-3
"""Odds beforehand, against the set named, from which another set of wrong constants is one side of an equivalence, and
the least probability stated for a rival that no data could rule out: nobody knows prior odds better than that."""
BETTER = 4.0
"""2 ln of odds or likelihoods from which on one candidate is said to do better than another: two sigma."""
LIKELY = 0.5
"""Probability above which a cause that is not named is said to be there, perhaps, as well: likelier than not."""
AS_GOOD = 0.1
"""Probability above which one that explains as much as the first is called as good: odds of ten to one are "strong"
evidence against it (Kass and Raftery)."""
LISTED = 0.005
"""Least probability of a rival that is listed: what is rounded to 1 %."""
EXPLAINABLE = 1.2
"""Times what noise alone leaves from which on an error holds something to explain: a fifth is what a run of 500
independent readings leaves open of its variance, by three sigma (3 sqrt(2/500))."""
SHOWN_COUNTS = 1.5
"""Counts by which an overshoot or a peak must differ to be listed as wrong: of two readings, each rounded by half a
count, half a count more than both can make."""
SHOWN_SETTLING = 0.05
"""Seconds by which settling times must: half a swing of a rig of 10 Hz, inside the band or not."""
OWN_COMMANDS = 0.1
"""Share of their rms by which a log's commands may miss those of its controller: of the measured logs rounding makes
0.002, a controller of another gain 0.8 or more; what a tenth changes no drawing shows, either."""
SHOWN_SHARE = 0.1
"""Error, as a share of the signal, from which on it is listed: a smaller one is hidden by the lines of a drawing."""
