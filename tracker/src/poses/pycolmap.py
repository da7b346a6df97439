"""COLMAP's steps by its Python package, for machines that have `pycolmap` but not the program.

    python -c THIS help
    python -c THIS feature_extractor|matches_importer|mapper --name value ...

Steps and options are named as in COLMAP's program of the same version. An option that this version does not know is an
error, as it is there. Pairs are compared by the package where it can take a list (4.0 and later); before, descriptors
are compared here by COLMAP's rules (ratio, angle, both ways) and checked geometrically by the package.
"""

import sys


def fail(message):
    print(message, file=sys.stderr)
    raise SystemExit(1)


try:
    import numpy
    import pycolmap
except ImportError as error:
    fail(f"{error}; `python3 -m venv venv` and `venv/bin/pip install pycolmap` bring it, then `--colmap venv/bin/python`")

#: From 3.13 on there are other features than SIFT, and what all share is in options of its own.
SHARED = hasattr(pycolmap, "FeatureExtractionOptions")


def options_of(words):
    """`--name value` pairs as a dictionary."""
    if len(words) % 2 or not all(name.startswith("--") for name in words[::2]):
        fail("options have to be `--name value` pairs")
    return {name[2:]: value for name, value in zip(words[::2], words[1::2])}


def as_type(text, old):
    """The value of an option in the type of its default."""
    if isinstance(old, bool):
        return text.lower() in ("1", "true")
    if isinstance(old, (int, float)):
        return type(old)(text)
    return text


def put(name, text, *places):
    """Sets an option in the first of the places that knows it."""
    attribute = name.split(".")[-1]
    for place in places:
        if hasattr(place, attribute):
            setattr(place, attribute, as_type(text, getattr(place, attribute)))
            return
    fail(f"unrecognised option '--{name}' in {pycolmap.COLMAP_version}")


def device(options, kind):
    """The processor, unless the graphics card is asked for by the name that this version has for it."""
    name = f"{'Feature' if SHARED else 'Sift'}{kind}.use_gpu"
    return pycolmap.Device.auto if options.pop(name, "0") == "1" else pycolmap.Device.cpu


def feature_extractor(options):
    extraction = pycolmap.FeatureExtractionOptions() if SHARED else pycolmap.SiftExtractionOptions()
    reader = pycolmap.ImageReaderOptions()
    arguments = {
        "database_path": options.pop("database_path"),
        "image_path": options.pop("image_path"),
        "device": device(options, "Extraction"),
        "reader_options": reader,
        "extraction_options" if SHARED else "sift_options": extraction,
    }
    if options.pop("ImageReader.single_camera", "0") == "1":
        arguments["camera_mode"] = pycolmap.CameraMode.SINGLE
    model = options.get("ImageReader.camera_model")
    # Before 4.0 the model is an argument too, whose default would win.
    if model and "camera_model:" in pycolmap.extract_features.__doc__:
        arguments["camera_model"] = model
    for name, text in options.items():
        if name.startswith("ImageReader."):
            put(name, text, reader)
        elif name.startswith("SiftExtraction."):
            put(name, text, extraction.sift if SHARED else extraction)
        elif SHARED and name.startswith("FeatureExtraction."):
            put(name, text, extraction)
        else:
            put(name, text)
    pycolmap.extract_features(**arguments)


def compare(first, second):
    """Indices of descriptors that are each other's nearest, by COLMAP's rules for SIFT."""
    rules = pycolmap.SiftMatchingOptions()
    if min(len(first), len(second)) < 2:
        return numpy.zeros((0, 2), numpy.uint32)
    # Descriptors have the length 512.
    cosines = first.astype(numpy.float32) @ second.astype(numpy.float32).T / 512.0**2

    def nearest(rows):
        two = numpy.partition(rows, -2, axis=1)[:, -2:]
        angles = numpy.arccos(numpy.clip(two, -1.0, 1.0))
        good = (angles[:, 1] <= rules.max_distance) & (angles[:, 1] < rules.max_ratio * angles[:, 0])
        return numpy.where(good, rows.argmax(axis=1), -1)

    there, back = nearest(cosines), nearest(cosines.T)
    index = numpy.arange(len(first))
    kept = (there >= 0) & (back[there] == index)
    return numpy.stack([index[kept], there[kept]], axis=1).astype(numpy.uint32)


def matches_importer(options):
    database_path, list_path = options.pop("database_path"), options.pop("match_list_path")
    if options.pop("match_type", "pairs") != "pairs":
        fail("only lists of pairs can be compared")
    where = device(options, "Matching")
    for name, text in options.items():
        put(name, text)
    if hasattr(pycolmap, "match_image_pairs"):
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = list_path
        pycolmap.match_image_pairs(database_path=database_path, pairing_options=pairing, device=where)
        return
    with open(list_path, encoding="utf-8") as lines:
        pairs = [line.split() for line in lines if line.strip()]
    is_static = "->" in (pycolmap.Database.open.__doc__ or "") and "self" not in pycolmap.Database.open.__doc__
    database = pycolmap.Database.open(database_path) if is_static else pycolmap.Database(database_path)
    numbers = {image.name: image.image_id for image in database.read_all_images()}
    descriptors = {}
    for pair in pairs:
        for name in pair:
            if name not in descriptors:
                descriptors[name] = database.read_descriptors(numbers[name])
        first, second = (numbers[name] for name in pair)
        if not database.exists_matches(first, second):
            database.write_matches(first, second, compare(*(descriptors[name] for name in pair)))
    database.close()
    pycolmap.verify_matches(database_path=database_path, pairs_path=list_path)


def mapper(options):
    paths = {name: options.pop(name) for name in ("database_path", "image_path", "output_path")}
    pipeline = pycolmap.IncrementalPipelineOptions()
    for name, text in options.items():
        put(name, text, pipeline, pipeline.mapper, pipeline.triangulation)
    if not pycolmap.incremental_mapping(**paths, options=pipeline):
        fail("failed to create sparse model")


def main(words):
    steps = {step.__name__: step for step in (feature_extractor, matches_importer, mapper)}
    name = words[0] if words else "help"
    if name in ("help", "-h", "--help"):
        print(f"{pycolmap.COLMAP_version} ({pycolmap.COLMAP_build}) by pycolmap: {', '.join(steps)}")
    elif name in steps:
        steps[name](options_of(words[1:]))
    else:
        fail(f"unknown step '{name}'")


if __name__ == "__main__":
    main(sys.argv[1:])
