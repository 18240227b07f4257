"""What the tests share says the same as what is made anew."""

from conftest import SIMULATED

from adaptfault.data.recordings import Recordings
from diagnostics import Fault, SelfDiagnosis, inject


def test_a_shared_fit_and_one_that_is_made_anew_say_the_same(small_grasps: Recordings, monkeypatch):
    reference = small_grasps.frames[:24]
    log = inject(small_grasps.frames[40], [Fault("stuck", (7,), value=1.0)], SIMULATED)
    fitted = [SelfDiagnosis(SIMULATED).fit(reference) for _ in range(2)]
    monkeypatch.setattr(SelfDiagnosis, "_fit", SelfDiagnosis._fit.__wrapped__)
    fitted.append(SelfDiagnosis(SIMULATED).fit(reference))
    first, *others = [diagnoser.diagnose(log).to_dict() for diagnoser in fitted]
    assert others == [first, first]
    assert fitted[0].reference_ is not fitted[1].reference_
