//! Every hazard of the method and of the fast field, with the test that holds it down: this list cannot rot, as each test
//! is looked up in its file.

use std::path::Path;

/// A hazard, and its tests as (file, function).
type Hazard = (&'static str, &'static [(&'static str, &'static str)]);

const STRESS: &str = "tests/tests/stress";

/// Hazards of the networks and of the pipeline around them.
const METHOD: &[Hazard] = &[
    (
        "SE(3) exponential at no rotation",
        &[
            ("trainer/src/se3.rs", "it_matches_the_check_vectors"),
            ("trainer/src/se3.rs", "the_gradient_at_rest_is_finite_and_right"),
        ],
    ),
    (
        "SE(3) exponential at large rotations",
        &[("poison_trainer.rs", "tensors_keep_poison_in_its_own_row_or_lose_it_to_a_bound")],
    ),
    (
        "logarithm of the uncertainty",
        &[
            ("trainer/src/loss.rs", "eq_17_matches_the_check_values"),
            ("poison_trainer.rs", "tensors_keep_poison_in_its_own_row_or_lose_it_to_a_bound"),
        ],
    ),
    (
        "overflow of softplus; rays that stay transparent",
        &[
            ("trainer/src/loss.rs", "a_sure_and_wrong_mask_still_has_a_gradient"),
            ("poison_trainer.rs", "tensors_keep_poison_in_its_own_row_or_lose_it_to_a_bound"),
        ],
    ),
    (
        "density times the endless last interval",
        &[("poison_trainer.rs", "tensors_keep_poison_in_its_own_row_or_lose_it_to_a_bound")],
    ),
    ("product of transmittances", &[("trainer/src/volume.rs", "it_matches_the_check_vector")]),
    (
        "division of eq. 1 by an empty or turned range",
        &[
            ("formats/src/au_scale.rs", "an_au_that_never_moves_rests"),
            ("poison_formats.rs", "attributes_and_curves_stay_in_their_ranges"),
        ],
    ),
    (
        "importance sampling of an empty ray",
        &[
            ("trainer/src/sampling.rs", "empty_rays_are_sampled_per_bin"),
            ("poison_trainer.rs", "samples_lie_where_they_may"),
        ],
    ),
    ("samples that coincide", &[("poison_trainer.rs", "samples_lie_where_they_may")]),
    (
        "logarithm of a saturated mask",
        &[
            ("trainer/src/loss.rs", "focal_matches_the_check_values"),
            ("trainer/src/loss.rs", "a_sure_and_wrong_mask_still_has_a_gradient"),
        ],
    ),
    (
        "masks that add up to more than 1, masked coordinates whose cosines are 1",
        &[
            ("trainer/tests/model.rs", "masks_and_uncertainties_leave_the_density_alone"),
            ("trainer/tests/model.rs", "with_the_hyper_window_shut_the_field_does_not_see_the_attributes"),
        ],
    ),
    (
        "a camera where it looks",
        &[
            ("poison_trainer.rs", "scores_and_paths_are_numbers_or_none"),
            ("extreme_scenes.rs", "extreme_scenes_fit_or_are_refused"),
        ],
    ),
    (
        "pixels beyond the fold of a lens",
        &[
            ("formats/src/camera_tests.rs", "a_pixel_beyond_the_fold_has_no_ray"),
            ("poison_formats.rs", "cameras_give_a_right_ray_or_none"),
        ],
    ),
    (
        "the domain of arcus cosine and sine",
        &[
            ("tracker/src/se3.rs", "the_logarithm_undoes_the_exponential"),
            ("poison_formats.rs", "alignments_and_axes_are_rigid_or_none"),
        ],
    ),
    (
        "rotations that are none",
        &[(
            "formats/src/nerfies/camera_tests.rs",
            "an_almost_orthonormal_rotation_is_repaired_and_a_wrong_one_refused",
        )],
    ),
    (
        "smoothing of short runs, over gaps, of NaN",
        &[
            ("formats/src/smooth.rs", "gaps_are_not_filtered_across"),
            ("poison_formats.rs", "attributes_and_curves_stay_in_their_ranges"),
        ],
    ),
    ("ICC without variance, or far from 0", &[("poison_trainer.rs", "scores_and_paths_are_numbers_or_none")]),
    (
        "PSNR of equal pictures, MS-SSIM of negatives",
        &[
            ("trainer/src/eval/ssim.rs", "a_picture_is_like_itself_and_unlike_its_negative"),
            ("poison_trainer.rs", "scores_and_paths_are_numbers_or_none"),
        ],
    ),
    ("times that stand still", &[("poison_tracker.rs", "cameras_between_and_around_stay_rigid")]),
    (
        "the border between two pieces of a schedule",
        &[("trainer/src/schedule.rs", "the_papers_schedules_match_the_check_values")],
    ),
    (
        "videos that ask to be turned",
        &[("tools/video/tests/against_ffmpeg.rs", "turned_and_mirrored_videos_are_shown_as_ffmpeg_does")],
    ),
    (
        "coordinates outside the unit ball of the encoding",
        &[("poison_trainer.rs", "tensors_keep_poison_in_its_own_row_or_lose_it_to_a_bound")],
    ),
    (
        "batches without annotations",
        &[
            ("trainer/src/loss.rs", "eq_17_matches_the_check_values"),
            ("long_run.rs", "scenes_that_lack_something_are_fitted"),
        ],
    ),
];

/// Hazards of the Gaussian field.
const FAST_FIELD: &[Hazard] = &[
    (
        "a Gaussian behind the camera, on it, as large as the world or as small as nothing",
        &[
            ("poison_trainer.rs", "pictures_are_finite_wherever_they_are_taken_from"),
            ("poison_trainer.rs", "a_gaussian_of_extreme_numbers_spoils_no_picture"),
        ],
    ),
    (
        "thousands of Gaussians in one tile, and none",
        &[("poison_trainer.rs", "a_gaussian_of_extreme_numbers_spoils_no_picture")],
    ),
    ("gradients merged in any order", &[("determinism.rs", "avatars_and_their_pictures_repeat_themselves")]),
    (
        "numbers of a file that is damaged or hostile",
        &[
            ("fuzz_folders.rs", "avatars_with_a_hostile_description"),
            ("fuzz_folders.rs", "avatars_with_hostile_arrays"),
        ],
    ),
    (
        "all-background pictures, one frame, one view",
        &[
            ("long_run.rs", "scenes_that_lack_something_are_fitted"),
            ("extreme_scenes.rs", "extreme_scenes_fit_or_are_refused"),
        ],
    ),
    (
        "drift over many steps",
        &[
            ("long_run.rs", "a_thousand_steps_neither_drift_nor_grow"),
            ("long_run.rs", "two_hundred_thousand_steps_neither_drift_nor_grow"),
        ],
    ),
];

#[test]
fn every_hazard_has_its_test() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut missing = Vec::new();
    for (hazard, tests) in METHOD.iter().chain(FAST_FIELD) {
        assert!(!tests.is_empty(), "{hazard}");
        for (file, test) in *tests {
            let path = if file.contains('/') { root.join(file) } else { root.join(STRESS).join(file) };
            let text = std::fs::read_to_string(&path).unwrap_or_default();
            if !text.contains(&format!("fn {test}(")) {
                missing.push(format!("{hazard}: {file} has no test `{test}`"));
            }
        }
    }
    assert!(missing.is_empty(), "{}", missing.join("\n"));
}
