//! Mutated and hostile bytes through every parser of a single file: never a panic, never memory out of proportion, never
//! a number that is none in what comes back, and every refusal one clean line.
//!
//! Seeds are small files written here and, where the development data is there, the heads of real ones.

use std::fmt::Display;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use risorius_dataset::provenance::Provenance;
use risorius_formats::attribute::AttributeTable;
use risorius_formats::curves::Curves;
use risorius_formats::intensities::Intensities;
use risorius_formats::mask::LabelImage;
use risorius_formats::nerfies::{self, Polygons};
use risorius_formats::pose_report::PoseReport;
use risorius_formats::run::RunManifest;
use risorius_formats::views::ViewList;
use risorius_formats::{Attribute, Camera, Intensity, RegionTable, Silent, TakeManifest, colmap, frame, openface};
use risorius_tests::shared;
use risorius_tracker::models::manifest::Manifest;
use risorius_trainer::path::CameraPath;

use crate::MEMORY;
use crate::mutate::mutation;

/// Mutations per parser in the quick part.
const MUTATIONS: u64 = 1500;
/// Memory that a parser may take beyond a multiple of its input.
pub(crate) const ROOM_BYTES: usize = 48 << 20;
/// The multiple.
pub(crate) const TIMES: usize = 256;

/// What a parser answers: what it made is checked already.
type Answer = Result<(), String>;

/// `Err` of a refusal as text; `Ok` after `sound` found nothing wrong with what was parsed.
fn answer<T, E: Display>(result: Result<T, E>, sound: impl FnOnce(&T) -> bool) -> Answer {
    match result {
        Ok(value) => {
            assert!(sound(&value), "what was parsed holds a number that is none");
            Ok(())
        }
        Err(e) => Err(e.to_string()),
    }
}

/// How much longer to fuzz than in the quick part.
pub(crate) fn times() -> u64 {
    std::env::var("RISORIUS_STRESS").ok().and_then(|v| v.parse().ok()).unwrap_or(1)
}

/// Throws mutations at a parser.
fn fuzz(name: &str, seeds: &[Vec<u8>], parse: impl Fn(&[u8]) -> Answer) {
    let (mut taken, mut most) = (0u64, 0usize);
    let count = MUTATIONS * times();
    let mut feed = |bytes: &[u8], what: &str| {
        let fail = |why: &str| {
            let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("fuzz-failure.bin");
            std::fs::write(&path, bytes).unwrap();
            panic!("{name}, {what}: {why}; the input is {}", path.display());
        };
        MEMORY.reset_peak_usage();
        let before = MEMORY.current_usage();
        let answer = catch_unwind(AssertUnwindSafe(|| parse(bytes)));
        let used = MEMORY.peak_usage().saturating_sub(before);
        most = most.max(used);
        if used > ROOM_BYTES + TIMES * bytes.len() {
            fail(&format!("took {used} bytes for {}", bytes.len()));
        }
        match answer {
            Err(panic) => {
                let text = panic.downcast_ref::<String>().cloned();
                fail(&text.or_else(|| panic.downcast_ref::<&str>().map(|s| (*s).to_owned())).unwrap_or_default());
            }
            Ok(Ok(())) => taken += 1,
            Ok(Err(said)) => {
                if said.is_empty() || said.chars().any(char::is_control) {
                    fail(&format!("the refusal is not one clean line: {said:?}"));
                }
            }
        }
    };
    for (i, seed) in seeds.iter().enumerate() {
        feed(seed, &format!("seed {i}"));
    }
    for n in 0..count {
        feed(&mutation(seeds, n), &format!("mutation {n}"));
    }
    eprintln!("{name}: {count} mutations of {} seeds, {taken} taken, {} KiB at most", seeds.len(), most >> 10);
    assert!(taken >= 1, "{name}: not even a sound seed was taken");
}

/// The beginning of a real file, cut after a line.
fn head(path: &str, most: usize) -> Option<Vec<u8>> {
    let mut bytes = std::fs::read(shared(path)?).unwrap();
    if bytes.len() > most {
        bytes.truncate(most);
        bytes.truncate(bytes.iter().rposition(|&b| b == b'\n').map_or(most, |i| i + 1));
    }
    Some(bytes)
}

fn with_real(own: &[&str], real: &[(&str, usize)]) -> Vec<Vec<u8>> {
    let own = own.iter().map(|t| t.as_bytes().to_vec());
    own.chain(real.iter().filter_map(|(path, most)| head(path, *most))).collect()
}

fn camera_is_sound(c: &Camera) -> bool {
    let i = &c.intrinsics;
    [i.fx, i.fy, i.cx, i.cy, i.skew].iter().all(|v| v.is_finite())
        && c.camera_from_world.rotation.is_finite()
        && c.camera_from_world.translation.is_finite()
}

const OPENFACE: &str = "frame, face_id, timestamp, confidence, success, pose_Tx, pose_Ty, pose_Tz, pose_Rx, pose_Ry, pose_Rz, AU01_r, AU12_r, AU45_r, AU12_c\n\
    1, 0, 0.000, 0.98, 1, 1.0, 2.0, 600.0, 0.1, -0.2, 0.05, 0.00, 1.20, 0.30, 1.00\n\
    2, 0, 0.033, 0.97, 1, 1.1, 2.0, 601.0, 0.1, -0.2, 0.05, 0.10, 1.40, 5.00, 1.00\n\
    3, 0, 0.067, 0.00, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0\n";

#[test]
fn openface_tables() {
    let real = [
        ("data/openface_csv/of_1.x_doublespace_video2.csv", 24_000),
        ("data/openface_csv/of_1.x_headerspace_pyfeat_OpenFace_Test.csv", 24_000),
        ("data/openface_csv/of_2.2_livetalking_au.csv", 8_000),
        ("data/video/liveportrait_driving_d3.openface.csv", 24_000),
    ];
    fuzz("openface::parse", &with_real(&[OPENFACE], &real), |b| {
        answer(openface::parse(b, &openface::ReadOptions::default(), &Silent), |t| {
            t.rows.iter().all(|r| {
                r.intensities.iter().flatten().all(|v| (0.0..=5.0).contains(v))
                    && r.confidence.is_finite()
                    && r.landmarks.as_ref().is_none_or(|l| l.is_finite())
                    && r.head_pose.is_none_or(|p| p.rotation_rad.is_finite() && p.translation_mm.is_finite())
            })
        })
    });
}

#[test]
fn curves_of_three_sorts() {
    let own = [
        OPENFACE,
        "secs,AU12,AU1\n0,0,1\n0.5,5,\n1.5,2.5,nan\n",
        "frame,AU12_r\n0,0\n30,5\n",
        "Timecode,BlendShapeCount,EyeBlinkLeft,EyeBlinkRight,JawOpen,HeadYaw,HeadPitch,HeadRoll\n10:00:00:59.000,61,0.2,0.4,1.0,0.5,0,0\n10:00:01:00.500,61,0.2,0.4,0,0,0.5,0\n",
    ];
    fuzz("Curves::parse", &with_real(&own, &[]), |b| {
        answer(Curves::parse(b, &Silent), |c| {
            let rising = c.times_secs.windows(2).all(|w| w[0] < w[1]) && c.times_secs.iter().all(|t| t.is_finite());
            let sound = c.rows.iter().flatten().flatten().all(|v| (0.0..=5.0).contains(v));
            rising && sound && c.fps().is_finite() && c.head_rotations.iter().flatten().all(glam::DMat3::is_finite)
        })
    });
}

const CAMERAS: &str =
    "# Camera list\n1 OPENCV 640 480 500 501 320 240 -0.1 0.01 0.001 0\n2 SIMPLE_RADIAL 640 480 500 320 240 0.1\n";
const IMAGES: &str =
    "# Image list\n1 1 0 0 0 0.1 0.2 2 1 000000.png\n10.5 20.5 7 30 40 -1\n2 0.9 0.1 0 0 0.1 0.2 2 1 a b.png\n\n";
const POINTS: &str = "# points\n7 0.1 0.2 0.3 10 20 30 0.5 1 0 2 1\n9 1 2 3 0 0 0 nan\n";

#[test]
fn colmap_models_as_text() {
    let synthetic = "data/colmap/synthetic/txt";
    let real = |name: &str| [(format!("{synthetic}/{name}"), 6000)];
    let seeds = |own: &str, name: &str| {
        let real = real(name);
        with_real(&[own], &[(real[0].0.as_str(), real[0].1)])
    };
    fuzz("colmap::parse_cameras_text", &seeds(CAMERAS, "cameras.txt"), |b| {
        answer(colmap::parse_cameras_text(b), |cameras| {
            cameras.values().all(|c| c.intrinsics().is_err() || c.params.iter().all(|v| v.is_finite()))
        })
    });
    fuzz("colmap::parse_images_text", &seeds(IMAGES, "images.txt"), |b| {
        answer(colmap::parse_images_text(b), |images| {
            images.values().all(|i| {
                i.camera_from_world.orthonormality_error() < 1e-6 && i.camera_from_world.translation.is_finite()
            })
        })
    });
    fuzz("colmap::parse_points_text", &seeds(POINTS, "points3D.txt"), |b| {
        answer(colmap::parse_points_text(b), |points| points.values().all(|p| p.position.is_finite()))
    });
}

#[test]
fn colmap_models_as_bytes() {
    let cameras = colmap::parse_cameras_text(CAMERAS.as_bytes()).unwrap();
    let images = colmap::parse_images_text(IMAGES.as_bytes()).unwrap();
    let points = colmap::parse_points_text(POINTS.as_bytes()).unwrap();
    let seeds = |own: Vec<u8>, name: &str| {
        let mut seeds = vec![own];
        seeds.extend(head(&format!("data/colmap/synthetic/bin/{name}"), usize::MAX).filter(|b| b.len() < 100_000));
        seeds
    };
    fuzz("colmap::parse_cameras_binary", &seeds(colmap::cameras_to_binary(&cameras).unwrap(), "cameras.bin"), |b| {
        answer(colmap::parse_cameras_binary(b), |c| c.values().all(|c| c.params.iter().all(|v| v.is_finite())))
    });
    fuzz("colmap::parse_images_binary", &seeds(colmap::images_to_binary(&images).unwrap(), "images.bin"), |b| {
        answer(colmap::parse_images_binary(b), |images| {
            images.values().all(|i| {
                i.camera_from_world.orthonormality_error() < 1e-6 && i.camera_from_world.translation.is_finite()
            })
        })
    });
    fuzz("colmap::parse_points_binary", &seeds(colmap::points_to_binary(&points), "points3D.bin"), |b| {
        answer(colmap::parse_points_binary(b), |points| points.values().all(|p| p.position.is_finite()))
    });
}

#[test]
fn json_files() {
    let camera = r#"{"orientation":[[1,0,0],[0,1,0],[0,0,1]],"position":[0.1,0.2,-2],"focal_length":500,"principal_point":[320,240],"skew":0,"pixel_aspect_ratio":1,"radial_distortion":[0.1,0,0],"tangential_distortion":[0,0],"image_size":[640,480]}"#;
    fuzz("nerfies::parse_camera", &with_real(&[camera], &[("data/colmap/nerfies_camera.json", 10_000)]), |b| {
        answer(nerfies::parse_camera(b), camera_is_sound)
    });
    let views = r#"{"views":[{"id":"a","image":"a.png","camera":{"width":64,"height":48,"fx":60,"fy":60,"cx":32,"cy":24,"k1":0.1,"camera_from_world":[[1,0,0,0.1],[0,1,0,0.2],[0,0,1,2]]},"aus":{"AU12":3.5}},{"id":"b","camera":{"width":64,"height":48,"fx":60,"fy":60,"cx":32,"cy":24,"camera_from_world":[[1,0,0,0],[0,1,0,0],[0,0,1,2]]}}]}"#;
    fuzz("ViewList::parse", &with_real(&[views], &[("data/captures/ada/test/views.json", 4000)]), |b| {
        answer(ViewList::parse(b), |list| {
            list.views.iter().all(|v| {
                let stays = |p: &std::path::PathBuf| !p.is_absolute() && !p.to_string_lossy().contains("..");
                camera_is_sound(&Camera::from(&v.camera))
                    && v.aus.values().all(|a| a.is_finite())
                    && v.image.iter().chain(&v.depth).all(stays)
                    && !v.id.contains('/')
            })
        })
    });
    let labelme = r#"{"version":"5.0.1","flags":{},"shapes":[{"label":"AU01","points":[[1,2],[30,4],[5,60]],"group_id":null,"shape_type":"polygon","flags":{}},{"label":"AU12","points":[[1,2],[30,40]],"shape_type":"rectangle"}],"imagePath":"a.png","imageData":null,"imageHeight":48,"imageWidth":64}"#;
    fuzz("Polygons::parse", &with_real(&[labelme], &[]), |b| {
        answer(Polygons::parse(b), |p| {
            let image = p.label_image(&[("AU01", 1), ("AU12", 2)], 1, 64, 48);
            image.labels.iter().all(|&l| l < 3)
                && p.polygons.iter().all(|p| p.points_px.iter().flatten().all(|v| v.is_finite()))
        })
    });
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("file.json");
    let report = r#"{"method":"colmap-model","frames":3,"frames_tried":3,"frames_registered":3,"frames_interpolated":0,"registered_share":1.0,"reprojection_error_px":0.5,"landmark_error_px":1.0,"head_center":[0,0,2],"head_radius":0.1,"head_depth":[1.9,2.1],"near":1,"far":4,"background_depth":[3,4],"units_per_metre":null,"landmarks_in_world":[[0,0,2]],"seconds":1.5,"notes":[]}"#;
    fuzz("PoseReport::read", &with_real(&[report], &[]), |b| {
        std::fs::write(&path, b).unwrap();
        answer(PoseReport::read(&path), |r| r.head_center.is_finite() && r.near.is_finite())
    });
    let run = r#"{"version":1,"dataset":"data","dataset_sha256":"x","field":"splat","seed":1,"steps":10,"seconds":1.5,"written_by":"x"}"#;
    fuzz("RunManifest::read", &with_real(&[run], &[]), |b| {
        std::fs::write(&path, b).unwrap();
        answer(RunManifest::read(&path), |r| r.seconds.is_finite())
    });
}

#[test]
fn toml_files() {
    let text = |b: &[u8]| String::from_utf8_lossy(b).into_owned();
    let take = "version = 1\nsubject = \"S\"\nsource = \"video\"\nmedia = \"video.mp4\"\nmedia_sha256 = \"ab\"\noriginal_name = \"a.mp4\"\nwidth = 64\nheight = 96\nrotation_degrees = 0\nfps_asked = 30.0\nfps_measured = 29.97\nframe_count = 40\ndropped_frames = 0\nrepeated_frames = 0\nwritten_by = \"x\"\n";
    fuzz("TakeManifest::parse", &with_real(&[take], &[]), |b| {
        answer(TakeManifest::parse(&text(b)), |t| t.fps_measured.is_finite() && t.fps_asked.is_none_or(f64::is_finite))
    });
    let attributes = "regions = [\"brow\", \"mouth\"]\n[[attribute]]\nunit = \"AU01\"\nregion = 0\nau_min = 0.1\nau_max = 3.0\nau_max_scale = 0.8\nneutral = 0.2\nactive = true\n[[attribute]]\nunit = \"AU12\"\nregion = 1\nau_min = 0.0\nau_max = 0.05\nau_max_scale = 0.8\nneutral = 0.0\nactive = false\n";
    fuzz("AttributeTable::parse", &with_real(&[attributes], &[]), |b| {
        answer(AttributeTable::parse(&text(b)), |t| {
            t.attributes.iter().all(|a| {
                let scale = a.scale();
                (-1.0..=1.0).contains(&scale.attribute(Intensity(2.0)).0)
                    && scale.intensity(Attribute(0.3)).0.is_finite()
                    && scale.activation(Intensity(4.0)).0.is_finite()
            })
        })
    });
    let path_file = "fps = 25\n[[key]]\nsecs = 0\norbit = { yaw_deg = -20, zoom = 1.2 }\npreset = \"neutral\"\n[[key]]\nsecs = 2\norbit = { yaw_deg = 20 }\naus = { AU12 = 4, AU06 = 2 }\n";
    fuzz("CameraPath::parse", &with_real(&[path_file], &[]), |b| {
        answer(CameraPath::parse(&text(b)), |p| {
            let moments = p.moments();
            let sound = |m: &risorius_trainer::path::Moment| {
                m.secs.is_finite()
                    && m.orbit.is_none_or(|o| o.to_array().iter().all(|v| v.is_finite()))
                    && m.aus.iter().flatten().all(|(_, v)| (0.0..=5.0001).contains(v))
            };
            moments.len() < 200_000 && moments.iter().all(sound)
        })
    });
    let models = "version = 1\n[detector]\nfile = \"d.onnx\"\nkind = \"boxes\"\nwidth = 320\nheight = 240\nlayout = \"nchw\"\nmean = 127.0\nscale = 0.0078125\nboxes = \"boxes\"\nscores = \"scores\"\n[landmarks]\nfile = \"l.onnx\"\nkind = \"points68\"\nwidth = 64\nheight = 64\nlayout = \"nhwc\"\nscale = 0.0039\npoints = \"points\"\n";
    fuzz("models::Manifest::parse", &with_real(&[models], &[]), |b| {
        answer(Manifest::parse(&text(b)), |m| {
            let sound = |v: f32| v.is_finite();
            sound(m.detector.scale)
                && sound(m.detector.mean)
                && sound(m.landmarks.scale)
                && !m.detector.file.contains("..")
        })
    });
    let dir = tempfile::tempdir().unwrap();
    let regions = "[[regions]]\nname = \"brow\"\nunits = [\"AU01\", \"AU02\"]\n[[regions]]\nname = \"mouth\"\nunits = [\"AU12\"]\n";
    let at = dir.path().join("regions.toml");
    fuzz("RegionTable::read", &with_real(&[regions], &[]), |b| {
        std::fs::write(&at, b).unwrap();
        answer(RegionTable::read(&at).and_then(|t| t.validate()), |()| true)
    });
    let takes = "[[take]]\nname = \"a\"\nnumber = 0\nsubject = \"\"\nconsent = \"\"\nmedia_sha256 = \"x\"\nfps = 30.0\nframes = 40\n";
    let at = dir.path().join("takes.toml");
    fuzz("Provenance::read", &with_real(&[takes], &[]), |b| {
        std::fs::write(&at, b).unwrap();
        answer(Provenance::read(dir.path()), |_| true)
    });
    let settings = "[fit]\nseed = 3\nsteps = 100\nbudget = \"60s\"\n[build]\nframes = 750\n";
    fuzz("risorius.toml", &with_real(&[settings], &[]), |b| {
        std::fs::write(dir.path().join("risorius.toml"), b).unwrap();
        let read = risorius_console::settings_from::<toml::Table>(dir.path(), "fit");
        answer(read.map_err(|e| e.message().to_owned()), |_| true)
    });
}

#[test]
fn tables_yaml_and_label_images() {
    let frames = "index,timestamp_nanos,dropped_before,repeated,sharpness,luma_mean,motion,clipped_share\n0,0,0,false,12.5,100,,0.1\n1,33333333,0,false,,,,\n2,66666666,1,true,3,4,5,0\n";
    fuzz("frame::parse_frames", &with_real(&[frames], &[]), |b| {
        answer(frame::parse_frames(b), |rows| {
            let sound = |r: &risorius_formats::FrameRecord| {
                [r.sharpness, r.luma_mean, r.motion, r.clipped_share].iter().flatten().all(|v| v.is_finite())
            };
            rows.iter().all(sound)
        })
    });
    fuzz("Intensities::parse", &with_real(&["id,AU01,AU12\n000000,0.1,2\n000003,0,5\n"], &[]), |b| {
        answer(Intensities::parse(b), |t| t.rows.values().flatten().all(|v| v.is_finite()))
    });
    let annotations = "- class: 0\n  frame: 12\n  value: -1.0\n- {class: 1, frame: 12, value: 0.5}\n- value: 1.0e-3\n  frame: 3\n  class: 0\n";
    let laughs = "a: &a [x,x,x,x,x,x,x,x,x]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b,*b,*b,*b]\nd: &d [*c,*c,*c,*c,*c,*c,*c,*c,*c]\ne: [*d,*d,*d,*d,*d,*d,*d,*d,*d]\n";
    fuzz("nerfies::parse_annotations", &with_real(&[annotations, laughs], &[]), |b| {
        answer(nerfies::parse_annotations(b, 17), |a| a.iter().all(|a| a.value.is_finite() && a.class < 17))
    });
    fuzz("nerfies::parse_mapping", &with_real(&["0: AU01\n1: AU02\n2: \"AU04\"\n", laughs], &[]), |b| {
        answer(nerfies::parse_mapping(b), |_| true)
    });
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    let mut image = LabelImage::new(16, 12);
    image.labels[40..60].fill(2);
    image.write_png(&path).unwrap();
    fuzz("LabelImage::parse_png", &[std::fs::read(&path).unwrap()], |b| {
        answer(LabelImage::parse_png(b), |i| i.labels.len() == i.width as usize * i.height as usize)
    });
}

#[test]
fn boxes_of_videos() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("v.mp4");
    let mut seeds: Vec<Vec<u8>> = Vec::new();
    // An own file of 20 frames, and the head and tail of real ones.
    risorius_tests::succeed(
        "synth",
        &["-q", "--out", dir.path().join("c").to_str().unwrap(), "--frames", "8", "--size", "32x48"],
    );
    seeds.push(std::fs::read(dir.path().join("c/video.mp4")).unwrap());
    seeds.extend(head("data/video/pyfeat_no_face.mp4", 40_000));
    fuzz("fragmented::timeline and whole_fragments", &seeds, |b| {
        std::fs::write(&path, b).unwrap();
        let _ = risorius_video::fragmented::whole_fragments(&path);
        answer(risorius_video::fragmented::timeline(&path), |_| true)
    });
}
