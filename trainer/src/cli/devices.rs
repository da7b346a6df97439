//! `trainer devices`.

use risorius_console::Console;

use crate::devices;

pub(super) fn run(console: &Console) {
    let all = devices::list();
    let line = |k: &devices::DeviceKind| {
        let state = if !k.compiled_in {
            "not in this build".to_owned()
        } else if k.present.is_empty() {
            "in this build, none here".to_owned()
        } else {
            k.present.join("; ")
        };
        format!("{:5} {state} ({})", k.name, k.note)
    };
    let human: Vec<String> = all.iter().map(line).collect();
    console.finish(&all, &human.join("\n"));
}
