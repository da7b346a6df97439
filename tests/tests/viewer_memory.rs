//! A viewer that is asked again and again holds what it held: its server runs in this process, where allocations are
//! counted, and where no other test runs. (What a viewer's process holds of the system, the fault tests look at; there the
//! allocator breathes.)

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "what was measured is worth telling")]

use std::sync::atomic::{AtomicBool, Ordering};

use burn::tensor::Device;
use risorius_formats::{Reporter, Warning};
use risorius_tests::{Visitor, tiny};
use risorius_trainer::Avatar;
use risorius_trainer::jobs::transfer::Range;
use risorius_trainer::view::{ViewSettings, Viewer};

#[global_allocator]
static MEMORY: peak_alloc::PeakAlloc = peak_alloc::PeakAlloc;

/// Requests until every buffer is as large as it gets.
const WARM: usize = 200;
/// Requests after them.
const REQUESTS: usize = 1_000;
/// Requests for the same picture whenever memory is looked at.
const AGAIN: usize = 8;
/// Looks at memory after them.
const LOOKS: usize = 10;
/// Bytes that may be held more: a table or a queue that grows once.
const ROOM: usize = 256 << 10;

/// Stops the server when told to.
#[derive(Default)]
struct Stop(AtomicBool);

impl Reporter for Stop {
    fn stage(&self, _: &str, _: Option<u64>) {}
    fn advance(&self, _: u64) {}
    fn note(&self, _: &str) {}
    fn warn(&self, _: Warning) {}
    fn cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Stops the server however the test ends, or it would be waited for.
struct AtTheEnd<'a>(&'a Stop);

impl Drop for AtTheEnd<'_> {
    fn drop(&mut self) {
        self.0.0.store(true, Ordering::Relaxed);
    }
}

#[test]
fn a_viewer_holds_what_it_held() {
    // What a thread works in, it makes when it first has something to do: with one thread, that is at once.
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global().unwrap();
    let run = tiny().join("splat");
    let avatar = Avatar::open(&run, &Device::default()).unwrap();
    let settings = ViewSettings { run, port: 0, curves: None, live: None, live_range: Range::Avatar };
    let stop = Stop::default();
    let viewer = Viewer::bind(&avatar, &settings, &stop).unwrap();
    let mut visitor = Visitor::of(&viewer.url());
    std::thread::scope(|scope| {
        let at_the_end = AtTheEnd(&stop);
        let server = scope.spawn(|| viewer.serve(&stop).unwrap());
        let frame = format!("/{}/frame", visitor.token);
        // What is held after some requests, each time with the same picture in mind: the least of some moments, as a thread
        // that ends gives back its last allocations after its answer has come.
        let mut held = |requests: usize| {
            (0..requests).for_each(|_| visitor.ask_something());
            let again = |least: usize, _| {
                assert_eq!(visitor.ask("POST", &frame, br#"{"scale":0.5,"orbit":{"yaw_deg":5}}"#), 200);
                least.min(MEMORY.current_usage())
            };
            (0..AGAIN).fold(usize::MAX, again)
        };
        let warm = held(WARM);
        let after: Vec<usize> = (0..LOOKS).map(|_| held(REQUESTS / LOOKS)).collect();
        drop(at_the_end);
        let pictures = server.join().unwrap();
        eprintln!("{warm} bytes held, then {after:?}; {pictures} pictures");
        assert_eq!(pictures as usize, (WARM + REQUESTS) / 8 * 3 + (LOOKS + 1) * AGAIN, "pictures of the requests");
        // What is kept of each picture grows from look to look; what grows once in a while is room for more.
        let grew = (1..LOOKS).filter(|&i| after[..i].iter().all(|before| after[i] > *before)).count();
        assert!(grew <= LOOKS / 2, "more than ever was held at {grew} of {LOOKS} looks: {after:?}");
        let last = after[after.len() - 1];
        assert!(last <= warm + ROOM, "{warm} bytes were held, {last} are");
    });
}
