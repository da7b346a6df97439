//! Why a stage could not go on, for somebody who typed only `risorius avatar`.
//!
//! Messages of the stages are kept; hints that name options of other commands give way to what helps here.

use std::path::Path;

use risorius_console::Failure;

use super::options::Layout;
use super::stages::AvatarStage;
use crate::words::ours;

/// A stage's failure with what to do about it.
pub(super) fn explained(failure: Failure, stage: AvatarStage, layout: &Layout) -> Failure {
    let message = failure.message().to_owned();
    let has = |words: &[&str]| words.iter().any(|w| message.contains(w));
    let take = quoted(&layout.take);
    let out = layout.out.display();
    match stage {
        AvatarStage::Record | AvatarStage::RecordDriver if has(&["already exists"]) => {
            Failure::input(format!("{message}, and was made of another video or with other settings"))
                .with_hint("choose another `--out`, or remove that folder")
        }
        AvatarStage::Record | AvatarStage::RecordDriver if has(&["has no times"]) => {
            failure.with_hint(format!(
                "make a take with its rate, then go on with it: `risorius capture record --input VIDEO --fps 30 --out TAKE`, \
                 `risorius avatar TAKE --out {out}`"
            ))
        }
        AvatarStage::Track if has(&["no frame has `success`"]) => failure.with_hint(
            "is it the table of this video? Rows with `success` 0 or a low `confidence` are not used; `min-confidence` in \
             the table [tracker-import] of risorius.toml lowers the limit",
        ),
        AvatarStage::Track if has(&["none of its"]) => failure.with_hint(
            "is it the table of another video? `first-frame` in the table [tracker-import] of risorius.toml says which \
             number the first frame has in it",
        ),
        AvatarStage::Cameras if has(&["cannot start `"]) => Failure::input(
            "the camera moves in this video, and COLMAP, which finds its path, is not installed",
        )
        .of_installation()
        .with_hint(
            "install it with `apt-get update && apt-get install colmap`, then type the same command again: it goes on from \
             here; a video from a camera that stands still does without COLMAP",
        ),
        AvatarStage::Cameras if has(&["frames, too few"]) => failure
            .with_hint("record some seconds of lively expressions, such as 20 s"),
        AvatarStage::Cameras
            if has(&["placed only", "found no camera poses", "of low quality", "hardly move around", "`colmap "]) =>
        {
            failure.with_hint(format!(
                "film again: move the camera slowly around a head that is held still, before a background with texture, or \
                 put the camera down and turn the head. If it did stand still: `risorius tracker poses {take} --method head`. \
                 To take what there is: `risorius tracker poses {take} --accept-poor`. Then the same command goes on"
            ))
        }
        AvatarStage::Dataset if has(&["has a usable face"]) => {
            failure.with_hint("the face is lost or has no camera in all frames; `risorius tracker check` says where")
        }
        AvatarStage::Fit if has(&["is not a finite number"]) => {
            failure.with_hint("type the same command again; if it stops again, please report it")
        }
        _ => match failure.hint().map(ours) {
            Some(hint) => failure.with_hint(hint),
            None => failure,
        },
    }
}

/// A path as it is typed in a shell.
pub(super) fn quoted(path: &Path) -> String {
    let text = path.display().to_string();
    let plain = |c: char| c.is_alphanumeric() || "/._-+@%,:=~".contains(c);
    if !text.is_empty() && text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', "'\\''")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout() -> Layout {
        Layout { out: "my face".into(), take: "my face/takes/a".into(), take_is_given: false, driver: None }
    }

    #[test]
    fn cameras_that_fail_say_how_to_go_on() {
        let of = |text: &str| explained(Failure::input(text), AvatarStage::Cameras, &layout());
        let missing = of("cannot start `colmap`: No such file or directory");
        assert!(missing.message().contains("COLMAP") && missing.hint().unwrap().contains("apt-get install colmap"));
        let few = of("COLMAP placed only 3 of 40 key frames");
        assert!(few.hint().unwrap().contains("`risorius tracker poses 'my face/takes/a' --accept-poor`"));
        let short = of("the take has only 4 frames, too few to find cameras from");
        assert!(short.hint().unwrap().contains("some seconds"), "{short:?}");
    }

    #[test]
    fn other_hints_are_kept_in_our_words() {
        let failure = Failure::input("x").with_hint("`tools/models` fetches them");
        let explained = explained(failure, AvatarStage::Track, &layout());
        assert_eq!(explained.hint(), Some("`risorius models` fetches them"));
    }

    #[test]
    fn paths_are_quoted_where_a_shell_needs_it() {
        assert_eq!(quoted(Path::new("ada/run")), "ada/run");
        assert_eq!(quoted(Path::new("it's me")), "'it'\\''s me'");
    }
}
