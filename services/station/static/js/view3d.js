// Placeholder until the 3D view comes.
export class View3d { constructor() { this.on = false; } set(on) { this.on = on; } show() {} changed() {} draw() {} theme() {} take() {} fit() {} }
