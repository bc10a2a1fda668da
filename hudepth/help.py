"""The --help of the console scripts: what each does, the groups it is configured by, examples."""

from __future__ import annotations

from hudepth.base.verbs import conf_folder, options_of

ABOUT = {
    "train": "Train a monocular depth model and test its best checkpoint. All goes to runs/<name>/<date_time>/.",
    "test": "Score a checkpoint. It needs nothing but the checkpoint: model, data and split are recorded in it.",
    "data": "Prepare a data set once as a depth store, show what is known of it, or audit it for leaks and units.",
    "report": "Compare two runs, put several or a whole sweep in one table, draw figures, or check the paper's claims.",
    "predict": "Predict depth in metres for images, folders, videos or a camera, with any model file of hudepth's.",
    "export": "Write a checkpoint as ONNX, torch.export, OpenVINO, int8 or a bundle to share, each checked against it.",
    "bench": "Measure speed and memory of a model on this machine, in every backend.",
    "demo": "Open a page on this machine: drop a picture, see its depth, read distances, turn the point cloud.",
}

USAGE = {
    "train": "hudepth-train [+experiment=NAME] [group=NAME ...] [key=value ...]",
    "test": "hudepth-test checkpoint=<file | run directory | last> [data=NAME] [protocol=NAME] [key=value ...]",
    "data": "hudepth-data prepare|info|audit data=NAME [data.root=PATH] [key=value ...]",
    "report": "hudepth-report compare|table|sweep|figures|paper [key=value ...]",
    "predict": "hudepth-predict [checkpoint=<model>] input=<image | folder | 'glob' | video | camera> [output=DIR]",
    "export": "hudepth-export checkpoint=<model> format=[onnx,openvino,torch_export,int8,bundle] [output=DIR]",
    "bench": "hudepth-bench checkpoint=<model> | model=NAME [key=value ...]",
    "demo": "hudepth-demo [checkpoint=<model>] [port=7860]",
}

EXAMPLES = {
    "train": (
        ("hudepth-train +experiment=demo", "a first model, in minutes, on built-in rooms"),
        ("hudepth-train +experiment=badcl data=nyu_labeled data.root=nyu", "the paper's recipe on real NYU depth"),
        ("hudepth-train +experiment=finetune data=folder data.root=mine", "go on from checkpoint=nyu, on your images"),
        ("hudepth-train loss=silog optim.lr=3e-4 trainer.max_epochs=10", "other parts, other values"),
        ("hudepth-train -m loss=badcl,l1,silog seed=1,2,3", "every combination, one run each"),
        ("hudepth-train +sweep=loss_terms seed=1,2 sweep_dir=terms", "an ablation; typed again, it goes on"),
        ("hudepth-train resume=runs/badcl/2025-08-11_12-00-00", "go on after an interruption"),
    ),
    "test": (
        ("hudepth-test checkpoint=last", "the newest run, under the paper's and the eigen protocol"),
        ("hudepth-test checkpoint=runs/badcl/2025-08-11_12-00-00", "the best checkpoint of a run"),
        ("hudepth-test checkpoint=best.ckpt protocol=eigen", "a file, one protocol"),
        ("hudepth-test checkpoint=best.ckpt data.root=/data/nyu", "the same data, in another place"),
        ("hudepth-test checkpoint=best.ckpt data=rooms", "other data than it was trained on"),
    ),
    "data": (
        ("hudepth-data info data=nyu_labeled data.root=nyu", "pairs, scenes, splits"),
        (
            "hudepth-data audit data=densedepth data.root=nyu",
            "what each kind of split leaks; the list of names will do",
        ),
        ("hudepth-data prepare data=nyu_labeled data.root=nyu", "decode, check and resize everything once"),
        ("hudepth-data prepare data=densedepth data.root=nyu_data.zip", "straight from the zip"),
        ("hudepth-data prepare data=folder data.root=mine data.encoding=uint16_mm", "your own images and depths"),
        ("hudepth-data prepare data=manifest data.root=mine data.on_error=skip", "leave out, and list, bad files"),
    ),
    "report": (
        ("hudepth-report compare a=runs/badcl/A b=runs/l1/B", "is b better, on the same test images, and where"),
        ("hudepth-report table runs=[A,B,C] protocol=[paper,eigen]", "results side by side, and in what they differ"),
        ("hudepth-report sweep dir=sweeps/losses/A", "a sweep's variants over their seeds: tables, plots, one page"),
        ("hudepth-report figures run=last", "loss curves and RGB / truth / prediction panels of a run"),
    ),
    "predict": (
        (
            "hudepth-predict input=photos",
            "a folder: 16-bit PNG [mm], npy [m] and a picture for each image",
        ),
        ("hudepth-predict checkpoint=last input=photos", "the newest run instead of the model that comes along"),
        ("hudepth-predict checkpoint=model.onnx input=a.jpg formats=[ply]", "a point cloud, from an exported file"),
        ("hudepth-predict checkpoint=last input=walk.mp4 smoothing=0.6", "a video of depth, steadied"),
        ("hudepth-predict checkpoint=last input=0 frames=100", "the first camera"),
    ),
    "export": (
        ("hudepth-export checkpoint=last format=onnx", "uint8 RGB in, metres out, any batch size"),
        ("hudepth-export checkpoint=last format=[openvino,int8]", "the fastest on CPUs, exact and quantised"),
        ("hudepth-export checkpoint=last format=bundle zip=true", "weights, configuration, ONNX, model card, samples"),
    ),
    "bench": (
        ("hudepth-bench checkpoint=last", "every backend that is installed, batches of 1 to 32"),
        ("hudepth-bench model=hybrid_unet backends=[eager,openvino] batches=[1]", "two backends, random weights"),
    ),
    "demo": (
        ("hudepth-demo", "at http://127.0.0.1:7860, for this machine alone"),
        ("hudepth-demo checkpoint=last", "the newest run instead of the model that comes along"),
        ("hudepth-demo checkpoint=model.onnx port=8000", "an exported file, on another port"),
    ),
}

SHARED_OPTIONS = (
    ("--cfg job", "print the configuration and stop"),
    ("-m", "multirun: comma-separated values become one run each"),
    ("debug=true", "show the traceback of an error"),
    ("-sc install=bash", 'tab completion: eval "$(hudepth-train -sc install=bash)"; also zsh, fish'),
)


def help_text(task: str) -> str:
    """Return the help of ``hudepth-<task>``."""
    lines = [ABOUT[task], "", f"  {USAGE[task]}", "", "Examples"]
    width = max(len(command) for command, _ in EXAMPLES[task])
    lines += [f"  {command:<{width}}  {meaning}" for command, meaning in EXAMPLES[task]]
    groups = _groups(task)
    lines += ["", "Groups (choose with group=NAME)"] if groups else []
    lines += [f"  {group:<12}{', '.join(options_of(group))}" for group in groups]
    lines += ["", "Options"]
    lines += [f"  {option:<18}{meaning}" for option, meaning in SHARED_OPTIONS]
    return "\n".join(lines)


def _groups(task: str) -> list[str]:
    """Return the groups a task's configuration is made of, plus those that can be added."""
    text = (conf_folder() / f"{task}.yaml").read_text(encoding="utf-8")
    named = [line.split("-", 1)[1].split(":")[0].strip() for line in text.splitlines() if line.startswith("  - ")]
    groups = [name for name in named if name not in ("_self_", "hydra", "paths") and " " not in name]
    return [*groups, "experiment", "sweep"] if task == "train" else groups
