"""Score a model by scene and severity: `python -m torchrefract.robustness model=NAME data=DIR out=DIR`.

Writes results.csv, results.json and report.html: scores by image with 95 % intervals, COCO's mAP or the mean IoU of the
set, the value of a physical quantity that the model tolerates ("visibility at least 142 m"), and the worst pictures. A
picture has the same fog, lens or haze at all severities but for its strength. Without labels, a prediction is scored by
its agreement with that for the clean picture. A run that is stopped continues where it was.

Options:
    model=NAME              required: package.module:name of a function from images (1, 3, H, W) in [0, 1] to
                            predictions, torchvision:NAME, transformers:NAME or a folder, ultralytics:FILE (.pt of
                            YOLO), opencv:hog (pedestrians), or a file .pt2, .onnx or .pt
    data=DIR                folder of pictures, required
    out=DIR                 output folder, required
    labels=PATH             COCO JSON, or a folder of YOLO files or of masks with the names of the pictures; its
                            classes must have the numbers of those of the model
    scene=[NAME,...]        cheap_dashcam, cape_town_fog, limpopo_sun_glare, highveld_heat_haze, ..., or yours: a file
                            .yaml, or package.module:function from a severity to an effect
    severity=[1,3,5]        1 to 5
    score=NAME              package.module:name of a function from a prediction and a target to a number in [0, 1]
    depth=DIR               depth maps of the pictures, as estimate_depth writes
    camera=FILE             of the pictures, for all scenes; horizon=0.5 of their height, 0 at the top
    base=DIR                output folder of an earlier run of another model, for the errors relative to it (mCE)
    loss=0.1                share of the clean score that is tolerated; weights=FILE for a model of torchvision
    worst_case=true         state also the worst of worst_case_draws=8 random draws, which takes 8 times as long
    device=cuda             of the model and the effects; batch_size=8 versions of a picture that it predicts at once
    limit=N                 number of pictures; seed=0 of the draws

Examples:
    python -m torchrefract.robustness model=opencv:hog data=frames out=robustness scene=[cape_town_fog]
    python -m torchrefract.robustness model=my_detector:predict data=frames labels=instances.json out=robustness
"""

from torchrefract.cli.entry import command

main = command("robustness", __doc__, "robustness:test_robustness", has_sweeps=False)

if __name__ == "__main__":
    main()
