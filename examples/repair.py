"""Ten lines: recordings in, a broken row found, the classifier repaired. Run: python
examples/repair.py"""

import adaptfault as af
from diagnostics import Line, SelfDiagnosis, inject, line_fault


def main() -> None:
    grasps = af.simulate(n_per_class=30)  # or: af.load("grasps/").recordings
    windows = af.make_windows(grasps.frames, grasps.labels, grasps.layout)
    training, validation, test = af.split(windows)
    # quick to learn
    model = af.TactileTransformer(grasps.layout, n_classes=7, padding="valid", init="glorot")
    af.train(model, training, validation, epochs=5)  # a real one takes 20 to 50

    row = line_fault(grasps.layout, Line(pad=0, kind="row", index=5), "short")
    broken = [inject(frames, [row], grasps.layout) for frames in grasps.frames]
    broken_test = af.make_windows(broken, grasps.labels, grasps.layout)
    broken_test = broken_test.select([r in set(test.recording) for r in broken_test.recording])

    healthy = [grasps.frames[i] for i in set(training.recording)]
    diagnosis = SelfDiagnosis(grasps.layout).fit(healthy).diagnose(broken[60:75])
    adaptation = af.Adapter(model, training, validation).adapt(diagnosis.fault_set, method="fill")

    print(diagnosis)
    print("healthy :", af.evaluate(model, test))
    print("broken  :", af.evaluate(model, broken_test))
    print("repaired:", af.evaluate(adaptation, broken_test))


if __name__ == "__main__":
    main()
