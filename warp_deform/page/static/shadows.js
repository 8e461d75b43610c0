// Shadows on the table without shadow maps, for where the processor draws: everything flattened
// along the light onto the table, cut off at its edges.
import * as T from "./three.js";

const HEIGHT = 0.0004;

export class FlatShadows {
  /** `light`: from the lamp to the table; `bounds`: [[x0, x1], [y0, y1]] of the table. */
  constructor(scene, light, bounds) {
    const [[x0, x1], [y0, y1]] = bounds, plane = (x, y, d) => new T.Plane(new T.Vector3(x, y, 0), d);
    this.paint = new T.MeshBasicMaterial({
      color: 0x1f1f1f, side: T.DoubleSide, fog: false,
      clippingPlanes: [plane(1, 0, -x0), plane(-1, 0, x1), plane(0, 1, -y0), plane(0, -1, y1)],
    });
    const [a, b] = [-light[0] / light[2], -light[1] / light[2]];
    // what a ball of radius 1 hides from the lamp
    this.disc = new T.ConeGeometry(1, 0, 12, 1, true).applyQuaternion(new T.Quaternion().setFromUnitVectors(new T.Vector3(0, 1, 0), new T.Vector3(...light).normalize()));
    this.group = new T.Group();
    this.group.matrixAutoUpdate = false;
    // x + a z, y + b z, and almost no height
    this.group.matrix.set(1, 0, a, 0, 0, 1, b, 0, 0, 0, 0.0001, HEIGHT, 0, 0, 0, 1);
    scene.add(this.group);
  }

  /** Cast the shadows of meshes from now on; they share place and, but for `userData.outline`, geometry with them. */
  cast(name, meshes) {
    for (const old of this.group.children.filter(each => each.userData.name === name)) this.group.remove(old);
    for (const mesh of meshes) {
      const outline = mesh.userData.outline || mesh.geometry;
      const flat = mesh.isInstancedMesh ? new T.InstancedMesh(outline, this.paint, mesh.count) : new T.Mesh(outline, this.paint);
      if (mesh.isInstancedMesh) flat.instanceMatrix = mesh.instanceMatrix;
      flat.matrixAutoUpdate = false;
      flat.frustumCulled = false;
      flat.visible = mesh.visible;
      Object.assign(flat.userData, {name, of: mesh});
      this.group.add(flat);
    }
  }

  follow() {
    for (const flat of this.group.children) {
      const {of} = flat.userData;
      if (of.matrixAutoUpdate) of.updateMatrix();
      flat.matrix.copy(of.matrix);
      flat.matrixWorldNeedsUpdate = true;
    }
  }
}
