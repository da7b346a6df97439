//! The same gradient of every lane, so that it is merged in the order of the lanes.

use super::lane::Lane;
use crate::table::TableGrad;

/// The same gradient of every lane, column by column.
pub(super) struct Columns<'a> {
    lanes: Vec<LaneColumns<'a>>,
}

pub(super) struct LaneColumns<'a> {
    pub(super) head: Vec<Option<&'a mut TableGrad>>,
    pub(super) head_net: Option<&'a mut TableGrad>,
    pub(super) background: Vec<Option<&'a mut TableGrad>>,
    pub(super) background_net: Option<&'a mut TableGrad>,
    pub(super) masks: Option<&'a mut TableGrad>,
}

impl<'a> Columns<'a> {
    pub(super) fn new(lanes: &'a mut [Lane]) -> Self {
        let lanes = lanes
            .iter_mut()
            .map(|l| LaneColumns {
                head: l.head.features.iter_mut().map(Some).collect(),
                head_net: Some(&mut l.head.net),
                background: l.background.features.iter_mut().map(Some).collect(),
                background_net: Some(&mut l.background.net),
                masks: Some(&mut l.masks),
            })
            .collect();
        Self { lanes }
    }

    pub(super) fn take(
        &mut self,
        which: impl for<'c> Fn(&'c mut LaneColumns<'a>) -> &'c mut Option<&'a mut TableGrad>,
    ) -> Vec<&'a mut TableGrad> {
        self.lanes.iter_mut().filter_map(|lane| which(lane).take()).collect()
    }
}
