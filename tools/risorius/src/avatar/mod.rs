//! `risorius avatar`: every stage from a video to an avatar with its figures, by one command that can be stopped.
//!
//! ```text
//! OUT/takes/NAME   the take, with track/ and poses/        OUT/run        the avatar, with eval/
//! OUT/dataset      the frames to fit                       OUT/card.json  what came out, and what each stage took
//! OUT/DRIVER.mp4   with --from
//! ```
//!
//! The stages are the four programs' own commands with `--if-changed`: their records decide what is there already.

mod board;
mod card;
mod clock;
mod explain;
mod face;
mod kept;
mod options;
mod pipeline;
mod preflight;
mod programs;
mod session;
mod stages;
mod warnings;

pub(crate) use options::AvatarArgs;

use std::sync::Arc;

use risorius_console::{CommonArgs, Console, Failure};
use risorius_formats::Reporter as _;

use self::board::{Board, Ticker, seconds};
use self::options::{DriverSource, Layout};
use self::session::Session;
use self::stages::AvatarStage;

/// Runs `risorius avatar`.
pub(crate) fn run(args: &AvatarArgs, common: &CommonArgs, console: &Console) -> Result<(), Failure> {
    let layout = Layout::of(args)?;
    let plan = preflight::look(args, &layout)?;
    let stages = stages_of(&layout);
    let board = Arc::new(Board::new(&stages, plan, common));
    let mut session = Session::new(args, &layout, Arc::clone(&board));
    let _lock = session.lock()?;
    let expected: f64 = stages.iter().map(|&s| plan.expected_secs(s)).sum();
    board.say(&format!(
        "{} → {}: {} frames, {} stages, {} at most on two free cores",
        args.video.display(),
        layout.out.display(),
        plan.size.frames,
        stages.len(),
        seconds(expected)
    ));
    let ticker = Ticker::new(&board);
    let outcome = pipeline::run_all(&mut session);
    drop(ticker);
    board.finish();
    if let Err(failure) = outcome {
        let failure = if console.cancelled() {
            Failure::interrupted("what is done stays; the same command goes on from here")
        } else {
            failure
        };
        session.stop(&failure);
        return Err(failure);
    }
    let card = session.finish()?;
    console.finish(&card, &card.text());
    Ok(())
}

/// The stages that this avatar takes.
fn stages_of(layout: &Layout) -> Vec<AvatarStage> {
    use AvatarStage::{Cameras, Dataset, Fit, Record, RecordDriver, Score, Track, TrackDriver, Transfer};
    let mut stages = if layout.take_is_given { Vec::new() } else { vec![Record] };
    stages.extend([Track, Cameras, Dataset, Fit, Score]);
    match &layout.driver {
        Some(DriverSource::Video { .. }) => stages.extend([RecordDriver, TrackDriver, Transfer]),
        Some(DriverSource::Take(_)) => stages.extend([TrackDriver, Transfer]),
        Some(DriverSource::Table(_)) => stages.push(Transfer),
        None => {}
    }
    stages
}
