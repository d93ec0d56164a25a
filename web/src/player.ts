/** The clock of the page: a time in the motion, which loops over now and the futures. */

export class Player {
  time = 0;
  playing = false;
  private from = 0;
  private to = 1;
  private rested = 0;

  /** Loop from a little before now to the end of the futures. */
  loop(from: number, to: number): void {
    this.from = from;
    this.to = Math.max(to, from + 0.1);
  }

  /** Let time pass; whether anything moved. */
  tick(seconds: number): boolean {
    if (!this.playing) return false;
    if (this.time < this.to) {
      this.time = Math.min(this.time + seconds, this.to);
      this.rested = 0;
    } else if ((this.rested += seconds) > 0.8) {
      this.time = this.from;
    }
    return true;
  }
}
