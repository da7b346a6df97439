//! What was read has to fit together before anything looks into it.

use risorius_brick::Brick;
use risorius_brick::field::LAYERS;
use risorius_brick::lattice::{BRICK, Lattice};
use risorius_brick::table::Table;

use super::Content;

/// Makes lengths and counts agree with what was read, or says what does not: look-ups trust them.
pub(super) fn settle(model: &mut Brick, content: Content) -> Result<(), String> {
    let fresh = content == Content::Avatar;
    let lattice = |name: &str, lattice: &mut Lattice, expected: usize| {
        if lattice.slot.len() != expected {
            return Err(format!("`{name}` has {} bricks, expected {expected}", lattice.slot.len()));
        }
        lattice.slots = lattice.slot.iter().max().map_or(0, |&m| m as usize + 1);
        if lattice.slots > expected + 1 {
            return Err(format!("`{name}` names brick {} of {expected}", lattice.slots - 1));
        }
        Ok(())
    };
    let table = |name: &str, table: &mut Table, blocks: usize| {
        let n = blocks * table.block;
        // Before anything is made at the size that a damaged lattice asks for.
        if table.values.len() != n {
            return Err(format!("`{name}` has {} numbers, expected {n}", table.values.len()));
        }
        if fresh {
            (table.first, table.second) = (Vec::new(), Vec::new());
            // An avatar is read whatever blocks it was fitted with.
            table.steps.resize(blocks, 1);
        } else if [table.first.len(), table.second.len()] != [n; 2] {
            return Err(format!("the moments of `{name}` have not {n} numbers"));
        }
        if table.steps.len() != blocks {
            return Err(format!(
                "`{name}` has {} blocks, expected {blocks}: another version wrote it",
                table.steps.len()
            ));
        }
        Ok(())
    };
    for (name, part) in [("head", Some(&mut model.head)), ("background", model.background.as_mut())] {
        let Some(part) = part else { continue };
        for (l, (level, features)) in part.field.levels.iter_mut().zip(&mut part.field.features).enumerate() {
            let expected = level.bricks().iter().product();
            lattice(&format!("{name}.level{l}.slot"), level, expected)?;
            table(&format!("{name}.level{l}"), features, level.slots * LAYERS)?;
        }
        table(&format!("{name}.net"), &mut part.field.net, 1)?;
        let cells = risorius_brick::occupancy::COUNT;
        let o = &mut part.occupancy;
        if o.bits.len() != cells || o.density.len() != cells || o.weight.len() != 8 * cells {
            return Err(format!("`{name}.occupied` has {} cells, expected {cells}", o.bits.len()));
        }
        o.refresh();
    }
    let e = &mut model.expression;
    let expected = e.lattice.bricks().iter().product();
    lattice("expression.slot", &mut e.lattice, expected)?;
    e.lattice.slots = e.lattice.slots.max(1);
    if e.allowed.len() != e.lattice.slots * BRICK {
        return Err(format!("`expression.allowed` has {} vertices", e.allowed.len()));
    }
    if e.slots_of.iter().flatten().any(|&s| s as usize >= e.lattice.slots) {
        return Err("a region names a brick that is not there".to_owned());
    }
    if e.slots_of.iter().any(|slots| !slots.is_sorted_by(|a, b| a < b)) {
        return Err("the bricks of a region are not in order".to_owned());
    }
    e.list_vertices();
    for (k, residual) in e.residuals.iter_mut().enumerate() {
        table(&format!("expression.au{k}"), residual, e.slots_of[e.region_of[k]].len())?;
    }
    let slots = e.lattice.slots;
    table("expression.masks", &mut e.masks, slots)?;
    for (j, basis) in model.latent_bases.iter_mut().enumerate() {
        table(&format!("latent{j}"), basis, model.latent_lattice.slots)?;
    }
    table("codes", &mut model.codes, model.layout.images)?;
    if fresh {
        for table in [&mut model.alphas, &mut model.log_betas, &mut model.motions] {
            *table = Table::new(model.layout.images, table.block, || 0.0);
        }
    } else {
        table("alphas", &mut model.alphas, model.layout.images)?;
        table("log_betas", &mut model.log_betas, model.layout.images)?;
        table("motions", &mut model.motions, model.layout.images)?;
    }
    Ok(())
}
