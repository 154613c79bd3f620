import { mount } from 'svelte';
import '../app.css';
import Walk from './Walk.svelte';

mount(Walk, { target: document.getElementById('app')! });
