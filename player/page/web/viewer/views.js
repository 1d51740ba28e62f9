// The list of training views: choosing one flies there.

export class Views {
  // Fill the list `select`, and connect it and the buttons `before` and `after` beside it with the viewer.
  constructor(viewer, cameras, { select, before, after }) {
    this.viewer = viewer;
    this.select = select;
    this.n = cameras.length;
    const digits = String(this.n - 1).length;
    cameras.forEach(({ name }, index) => {
      const file = name.split("/").pop().replace(/\.\w+$/, "");
      select.add(new Option(`${String(index).padStart(digits, "\u2007")}  ${file}`, index));
    });
    select.addEventListener("change", () => viewer.flyToView(select.selectedIndex - 1));
    before.addEventListener("click", () => this.go(-1));
    after.addEventListener("click", () => this.go(1));
    viewer.onview = (index) => {
      select.selectedIndex = index + 1; // the first line stands for no view
      if (index >= 0) this.last = index;
    };
    this.last = -1;
    viewer.onview(viewer.views.indexOf(viewer.pose)); // the view that the address names
  }

  // Fly to the view `steps` places after the one chosen last in the list, which continues from its end at its beginning.
  go(steps) {
    const from = this.last < 0 && steps < 0 ? 0 : this.last;
    this.viewer.flyToView((from + steps + this.n) % this.n);
  }
}
