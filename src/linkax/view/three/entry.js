// What viewer.js uses of three.js 0.187.0. It is bundled to three.min.js by
//   npm install three@0.187.0 esbuild@0.28 && npx esbuild entry.js --bundle --minify --format=iife --global-name=THREE --outfile=three.min.js
export {
  BoxGeometry, BufferAttribute, BufferGeometry, Color, ConeGeometry, Curve, CylinderGeometry,
  DirectionalLight, DoubleSide, EdgesGeometry, GridHelper, Group, HemisphereLight, Line, LineBasicMaterial, LineSegments,
  Matrix4, Mesh, MeshStandardMaterial, PerspectiveCamera, Quaternion, Raycaster, Scene, SphereGeometry, TubeGeometry,
  Vector2, Vector3, WebGLRenderer,
} from "three";
export { ConvexGeometry } from "three/examples/jsm/geometries/ConvexGeometry.js";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
