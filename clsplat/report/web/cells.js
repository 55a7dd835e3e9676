// The parts of a model that are in the tables: of a large one first a coarse model of all of it,
// whose gaussians are replaced, cell by cell, by those that were merged into them. A device with
// little memory holds the cells near the reader only.
"use strict";

const HELD = 8e6, HELD_BY_A_PHONE = 1e6; // gaussians besides the coarse ones, at most

class Cells {
  constructor(model) {
    const all = model.cells, rows = (count) => Math.ceil(count / ROW) * ROW;
    this.cells = all.map((cell, number) => ({ ...cell, number, slot: -1 }));
    let at = 0;
    for (const cell of this.cells) at = (cell.coarseFirst = at) + cell.coarse;
    this.coarse = at;
    this.size = rows(Math.max(...all.map(({ count }) => count)));
    const small = matchMedia("(pointer: coarse)").matches || navigator.deviceMemory <= 4;
    const most = Math.max(1, Math.floor((small ? HELD_BY_A_PHONE : HELD) / this.size));
    this.slots = new Array(at ? Math.min(most, all.length) : 1).fill(null);
    this.rows = rows(at) + this.slots.length * this.size; // of the tables
  }

  first(slot) { return this.rows - (this.slots.length - slot) * this.size; }

  // Which gaussians show the model, as web/sort.js wants it; `coarse`: quickly.
  ranges(coarse = false) {
    return this.cells.map(({ slot, count, coarse: few, coarseFirst }) => (
      slot < 0 || (coarse && few) ? [0, coarseFirst, few] : [this.first(slot), 0, count])
    ).filter(([, , count]) => count);
  }

  // The nearest cell to a camera that is to be loaded into a slot, if there is one.
  missing({ position }) {
    const away = ({ centre }) => Math.hypot(...plus(centre, position, -1));
    const wanted = this.cells.map((cell) => [away(cell), cell]).sort((a, b) => a[0] - b[0])
      .slice(0, this.slots.length).map(([, cell]) => cell);
    const cell = wanted.find(({ slot }) => slot < 0);
    if (!cell) return undefined;
    return { cell, slot: this.slots.findIndex((held) => !held || !wanted.includes(held)) };
  }

  // That a cell is in a slot now, in place of another one.
  put({ cell, slot }) {
    if (this.slots[slot]) this.slots[slot].slot = -1;
    this.slots[slot] = cell;
    cell.slot = slot;
  }

  get isWhole() { return this.slots.length >= this.cells.length; }

  get share() { return this.slots.filter(Boolean).length / this.slots.length; }
}
